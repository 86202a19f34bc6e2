# Everything starts here: `make train` and `make test` set up what they need on a fresh machine.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
INTEROP := .venv-interop
OLDEST := .venv-oldest
PEERS  := .venv-peers
ARGS   ?=
ISAS   ?= AVX2 SSE4_2
EXPERIMENTS ?= training_difficulty training_set_size algorithm_comparison rainbow_evaluation

# Tests start hundreds of Python processes: what one has compiled is kept, also where the environment says otherwise.
export PYTHONDONTWRITEBYTECODE =

.PHONY: help install engine install-cuda train test test-fast test-slow test-isa test-browser test-interop test-oldest learning-seeds pipeline lint format lock bench bench-peers bench-micro soak soak-hosts fuzz docs clean

help:            ## show this list
	@grep -E '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 16

install: $(VENV)/.installed ## make the virtual environment in .venv

# uv takes half of pip's processor time. It does not read pip's settings: behind a mirror that is set there, pip installs.
$(VENV)/.installed: requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$$(grep ^uv== requirements.lock)"
	$(BIN)/uv pip install --quiet --python $(BIN)/python --no-deps -r requirements.lock \
	  || $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

engine: install  ## replace ViZDoom by a build of it that is twice as fast, made here in minutes (docs/ENGINE.md)
	$(BIN)/python -m gvz.engine.tuned.build_vizdoom

install-cuda: install ## add JAX for NVIDIA GPUs
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[cuda]'

train: install   ## run the main job (ARGS="--learner.total-updates 5000 ...")
	$(BIN)/python -m gvz.launch --config rainbow_4task.py $(ARGS)

test: install    ## all tests but the slow lane, in three processes (14 to 28 minutes on 2 cores)
	$(BIN)/python -m pytest -m "not slow and not browser" -n 3 --dist loadfile $(ARGS)

test-fast: install ## unit tests that start no engine
	$(BIN)/python -m pytest -m "not slow and not engine and not e2e and not browser" -n 2 --dist loadfile $(ARGS)

test-slow: install ## learning and fault tests that take minutes each
	$(BIN)/python -m pytest -m slow --timeout 1800 $(ARGS)

test-isa: install ## tests of learning and of the learner's numbers, as older processors compute them (ISAS=...)
	for isa in $(ISAS); do \
	  XLA_FLAGS=--xla_cpu_max_isa=$$isa $(BIN)/python -m pytest -m "isa and not slow" -n 2 --dist loadfile $(ARGS) || exit 1; \
	done

learning-seeds: install ## ten seeds of each test of learning, under three instruction sets
	for isa in AMX_FP16 AVX2 SSE4_2; do \
	  XLA_FLAGS=--xla_cpu_max_isa=$$isa $(BIN)/python -m pytest tests/learner/test_learning.py \
	    tests/learner/test_on_policy_learning.py --learning-seeds 10 --timeout 1800 -q $(ARGS) || exit 1; \
	done

pipeline: install ## the thesis's experiments at a two-thousandth of their size, and their report, in runs/pipeline
	$(BIN)/gvz experiment run $(EXPERIMENTS) \
	  --results runs/pipeline --scale 0.0005 --jobs 2
	$(BIN)/gvz report runs/pipeline --out runs/pipeline/report

test-browser: install ## reports opened in headless Chromium (Debian: apt-get install chromium)
	$(BIN)/python -m pytest -m browser $(ARGS)

test-interop: $(INTEROP)/.installed ## other libraries train on the environments, in .venv-interop, without JAX
	$(INTEROP)/bin/python -m pytest -o addopts= --import-mode importlib --confcutdir tests/interop tests/interop $(ARGS)

$(INTEROP)/.installed: examples/requirements.txt
	$(PYTHON) -m venv $(INTEROP)
	$(INTEROP)/bin/python -m pip install --quiet --disable-pip-version-check -r examples/requirements.txt
	$(INTEROP)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch $@

test-oldest: $(OLDEST)/.installed ## test-fast with the oldest packages that pyproject.toml allows, in .venv-oldest
	$(OLDEST)/bin/python -m pytest -m "not slow and not engine and not e2e and not browser" -n 2 --dist loadfile $(ARGS)

$(OLDEST)/.installed: pyproject.toml requirements.lock | install
	$(PYTHON) -m venv $(OLDEST)
	$(BIN)/uv pip compile --quiet --resolution lowest-direct --extra cluster --extra segmenter --extra video \
	  pyproject.toml --no-emit-index-url --no-emit-package opencv-python --output-file $(OLDEST)/oldest.txt
	for file in requirements.lock $(OLDEST)/oldest.txt; do \
	  $(BIN)/uv pip install --quiet --python $(OLDEST)/bin/python --no-deps -r $$file || exit 1; \
	done
	$(BIN)/uv pip install --quiet --python $(OLDEST)/bin/python --no-deps --no-build-isolation --editable .
	@touch $@

lint: install    ## format check, lint, types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/basedpyright

format: install  ## apply formatting and safe fixes
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: install   ## throughput beside limits and peers, 50 minutes on 2 quiet cores; then the page made of it
	$(BIN)/python -m benchmarks all --out results/performance $(ARGS)
	$(BIN)/python -m benchmarks.report

bench-peers: $(PEERS)/.installed $(PEERS)-dopamine/.installed ## the peers of `make bench`, in environments of their own

$(PEERS)/.installed: $(VENV)/.installed benchmarks/peers/requirements.txt
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python $(PEERS)
	$(BIN)/uv pip install --quiet --python $(PEERS)/bin/python -r benchmarks/peers/requirements.txt
	$(BIN)/uv pip install --quiet --python $(PEERS)/bin/python --no-deps levdoom==1.0.3
	@touch $@

$(PEERS)-dopamine/.installed: $(VENV)/.installed benchmarks/peers/requirements-dopamine.txt
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python $(PEERS)-dopamine
	$(BIN)/uv pip install --quiet --python $(PEERS)-dopamine/bin/python -r benchmarks/peers/requirements-dopamine.txt
	$(BIN)/uv pip install --quiet --python $(PEERS)-dopamine/bin/python --no-deps baselines==0.1.5
	@touch $@

soak: install    ## the main job for an hour while its actors are killed; then the page and plot made of it
	$(BIN)/python -m benchmarks.soak $(ARGS)
	$(BIN)/python -m benchmarks.reliability

soak-hosts: install ## a run on actor hosts for 20 minutes while these are killed; then the page made of it
	$(BIN)/python -m benchmarks.hosts_soak $(ARGS)
	$(BIN)/python -m benchmarks.reliability

fuzz: install    ## damaged input for all that parses, a minute a target, coverage-guided; then the page made of it
	$(BIN)/python -m tests.fuzz $(ARGS)
	$(BIN)/python -m benchmarks.reliability

bench-micro: install ## timed bodies of tests/perf
	$(BIN)/python -m pytest tests/perf --benchmark-enable $(ARGS)

docs: install    ## the documentation as a site, in site/
	$(BIN)/python -m mkdocs build --strict

lock: install    ## resolve requirements.lock from pyproject.toml
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --extra dev pyproject.toml \
	  --no-emit-index-url --no-header --no-annotate --no-emit-package opencv-python --output-file requirements.lock

clean:           ## remove the virtual environment and caches
	rm -rf $(VENV) $(INTEROP) $(OLDEST) $(PEERS) $(PEERS)-dopamine .pytest_cache .ruff_cache .hypothesis build dist
