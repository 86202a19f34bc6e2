"""Imports point down only: a folder is a tier (docs/ARCHITECTURE.md), checked from the syntax tree."""

import ast
import re
import subprocess
import sys
import tomllib
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
COMMANDS = ("gvz.launch", "gvz.cli")
"""beside the benchmark's modules, since `python -m gvz.launch` is what users type"""
BENCHMARK_MUST_NOT = ("jax", "flax", "optax", "chex", "orbax", "actors", "learner")
OURS = ("gvz", "actors", "learner", "configs")


@cache
def modules() -> list[tuple[str, Path]]:
    found = []
    for package in OURS:
        for file in sorted((ROOT / package).rglob("*.py")):
            parts = file.relative_to(ROOT).with_suffix("").parts
            found.append((".".join(parts[:-1] if parts[-1] == "__init__" else parts), file))
    return found


def imports_of(file: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            names.add(node.module or "")
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return names


def under(name: str, packages: tuple[str, ...]) -> bool:
    return any(name == p or name.startswith(p + ".") for p in packages)


def tier(module: str) -> int:
    """What the docstring of its package begins with: "Tier 1. ..."."""
    if module in COMMANDS:
        return 3
    folder = ROOT / module.replace(".", "/")
    while not (found := re.search(r"^Tier (\d)\.", docstring(folder / "__init__.py"), re.MULTILINE)):
        folder = folder.parent
        assert folder != ROOT, f"{module}: no package that it is in says its tier"
    return int(found[1])


@cache
def docstring(file: Path) -> str:
    return (ast.get_docstring(ast.parse(file.read_text())) or "") if file.exists() else ""


@pytest.mark.parametrize(("module", "file"), modules(), ids=lambda v: v if isinstance(v, str) else "")
def test_imports_point_down(module: str, file: Path):
    own = {name for _, name in [(f, m) for m, f in modules()]}
    for name in imports_of(file):
        target = name if name in own else name.rpartition(".")[0]
        if target in own and target != "gvz":
            assert tier(target) <= tier(module), f"{module} (tier {tier(module)}) imports {target}"
        if under(module, ("actors",)):
            assert not under(name, ("learner",)), f"{module} imports its sibling {name}"
        if under(module, ("learner",)):
            assert not under(name, ("actors",)), f"{module} imports its sibling {name}"
            assert target not in own or tier(target) != 1, f"{module} imports {target} of tier 1"
        if tier(module) <= 1:
            assert not under(name, BENCHMARK_MUST_NOT), f"{module} imports {name}"
        if under(name, ("vizdoom",)):
            assert module == "gvz.engine.engine", f"{module} imports vizdoom; only gvz.engine.engine may"


def test_the_page_says_which_libraries_the_vocabulary_imports():
    names = {name.partition(".")[0] for module, file in modules() if tier(module) == 0 for name in imports_of(file)}
    page = (ROOT / "docs" / "ARCHITECTURE.md").read_text()
    (said,) = re.findall(r"^\| 0 vocabulary .* \| (.*), standard library \|$", page, flags=re.MULTILINE)
    assert set(said.split(", ")) == names - sys.stdlib_module_names - {"gvz"}


def test_the_project_declares_the_libraries_that_it_imports_and_no_other():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [project["optional-dependencies"][extra] for extra in ("cluster", "segmenter", "video", "wandb")]
    declared = {re.match(r"[\w-]+", line)[0] for line in sum(extras, project["dependencies"])}
    libraries = {name.partition(".")[0] for _, file in modules() for name in imports_of(file)}
    libraries -= sys.stdlib_module_names | set(OURS)
    libraries -= {"stable_baselines3"}  # gvz.vector.adapters runs where it is installed
    of = packages_distributions()
    imported = {distribution for name in libraries for distribution in of.get(name, [name])}
    declared -= {"flatbuffers"}  # jax.export writes policies with it
    assert {name.lower().replace("_", "-") for name in imported} == {name.lower() for name in declared}


@pytest.mark.parametrize(
    ("statement", "forbidden"),
    [
        ("import gvz", ("gymnasium", "numpy", "jax", "vizdoom", "cv2")),
        ("import gvz.launch", ("jax", "vizdoom", "orbax", "flax")),
        ("import gvz.env, gvz.tasks", ("jax", "flax", "orbax", "tyro")),
        ("import gvz.tasks; gvz.tasks.all_scenarios()", ("numpy", "cv2", "jax")),
        (
            "from gvz.wad.acs import compile_acs; from gvz.wad.stock import stock_textures;"
            "compile_acs('script 1 OPEN { }'); stock_textures()",
            ("vizdoom", "jax", "omg", "cv2"),
        ),
        ("import gvz.cli, gvz.run.train, gvz.experiments.schedule", ("ray", "gvz.cluster.wire")),
    ],
)
def test_an_import_does_not_load(statement: str, forbidden: tuple[str, ...]):
    code = f"{statement}; import sys; print([m for m in {forbidden!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"
