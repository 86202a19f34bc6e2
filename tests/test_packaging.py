"""Wheel and sdist: what they hold, that they install, and that the benchmark runs where JAX cannot be imported."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.timeout(600)
PACKAGES = ("gvz", "actors", "learner", "configs")


def run(*command: str | Path, where: Path, **environment: str) -> str:
    done = subprocess.run(
        list(map(str, command)),
        cwd=where,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def tracked_files() -> set[str]:
    """What git knows of the packages."""
    return set(run("git", "ls-files", *PACKAGES, where=ROOT).splitlines())


def names_in_wheel(directory: Path) -> set[str]:
    (wheel,) = directory.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A directory with wheel and sdist, built by the environment's own hatchling: nothing is downloaded."""
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "hatchling", "build", "-d", out, where=ROOT)
    return out


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory) -> Path:
    """A clean environment with the wheel in it, and the dependencies of this one; the repository is not on its path."""
    where = tmp_path_factory.mktemp("clean") / "venv"
    run(sys.executable, "-m", "venv", "--without-pip", where, where=built)
    (packages,) = where.glob("lib/python*/site-packages")
    (wheel,) = built.glob("*.whl")
    python = where / "bin" / "python"
    run(
        sys.executable,
        "-m",
        "uv",
        "pip",
        "install",
        "-q",
        "--offline",
        "--no-deps",
        "--python",
        python,
        wheel,
        where=built,
    )
    # a line of a .pth is a directory to search; those of the editable installation there are not followed
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return where / "bin"


def test_the_wheel_holds_every_file_of_the_packages_and_nothing_else(built):
    names = {name for name in names_in_wheel(built) if ".dist-info/" not in name}
    assert tracked_files() <= names
    assert {name.partition("/")[0] for name in names} == set(PACKAGES)
    for needed in ("gvz/py.typed", "gvz/reports/templates/report.html.j2"):
        assert needed in names


def test_ray_comes_with_the_extra_cluster_alone(built):
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = [archive.read(n).decode() for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
    wanted = [line for line in metadata.splitlines() if re.match(r"Requires-Dist: (ray|zstandard)\b", line)]
    assert len([line for line in wanted if line.endswith("extra == 'cluster'")]) == 2
    assert all("; extra == " in line for line in wanted), "of what is installed without an extra"


def test_the_sdist_holds_what_a_wheel_is_built_from(built):
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert tracked_files() | {"pyproject.toml", "README.md", "LICENSE"} <= names


def test_the_dockerfile_has_no_finding_of_its_linter():
    run(Path(sys.executable).parent / "hadolint", "Dockerfile", where=ROOT)


def test_what_the_dockerfile_copies_makes_the_same_wheel(built, tmp_path):
    for line in (ROOT / "Dockerfile").read_text().splitlines():
        if line.startswith("COPY "):
            *sources, target = line.split()[1:]
            for source in (ROOT / name for name in sources):
                if source.is_dir():
                    shutil.copytree(source, tmp_path / target, ignore=shutil.ignore_patterns("__pycache__"))
                else:
                    shutil.copy(source, tmp_path / target)
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path / "dist", where=tmp_path)
    assert names_in_wheel(tmp_path / "dist") == names_in_wheel(built)


@pytest.mark.engine
def test_an_installed_wheel_works_from_an_empty_directory(installed, tmp_path):
    assert len(run(installed / "gvz", "tasks", "--json", where=tmp_path).splitlines()) == 76
    code = (
        "import gvz; e = gvz.make('dodge_projectiles/city'); print(gvz.__file__, e.reset(seed=1)[0].shape); e.close()"
    )
    file, _, shape = run(installed / "python", "-c", code, where=tmp_path).partition(" ")
    assert Path(file).is_relative_to(installed.parent)
    assert shape.strip() == "(84, 84, 3)"
    assert "--learner.total-updates" in run(
        installed / "gvz", "train", "--config", "dqn_quick", "--help", where=tmp_path
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.engine
def test_environments_and_their_evaluation_need_no_jax(tmp_path):
    (tmp_path / "jax").mkdir()
    (tmp_path / "jax" / "__init__.py").write_text("raise ImportError('there is no jax here')")
    here = {"where": tmp_path, "PYTHONPATH": str(tmp_path)}
    with pytest.raises(AssertionError, match="there is no jax here"):
        run(sys.executable, "-c", "import jax", **here)
    task = "health_gathering/supreme"
    code = f"import gvz, gymnasium; e = gvz.make('{task}'); e.reset(seed=1); print(e.step(0)[1]); e.close()"
    assert float(run(sys.executable, "-c", code, **here)) > 0
    gvz = (sys.executable, "-m", "gvz.cli")
    assert task in run(*gvz, "tasks", **here)
    playing = ("--player", "random", "--tasks", task, "--episodes", "1", "--workers", "1", "--out", "random.jsonl")
    assert task in run(*gvz, "evaluate", *playing, **here)


@pytest.mark.parametrize(
    ("command", "what"),
    [
        ("evaluate zoo:health_gathering --tasks health_gathering/slime", "playing by a trained policy"),
        ("record zoo:health_gathering --out episode.gif", "playing by a trained policy"),
        ("watch zoo:health_gathering", "playing by a trained policy"),
        ("gallery --kind augmented --scenario health_gathering --out .", "the sheet of augmentations"),
        ("zoo --add zoo:health_gathering --name mine", "adding a policy to the zoo"),
        ("train --config rainbow_quick", "training"),
    ],
)
def test_what_needs_jax_says_so_where_there_is_none(command, what, tmp_path):
    site = tmp_path / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text("import sys; sys.modules['jax'] = None")  # as if it were not installed
    (where := tmp_path / "empty").mkdir()
    done = subprocess.run(
        [sys.executable, "-m", "gvz.cli", *command.split()],
        cwd=where,
        env={**os.environ, "PYTHONPATH": f"{site}:{ROOT}", "GVZ_CACHE_DIR": str(tmp_path / "cache")},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    wanted = f"error: {what} needs JAX and the other libraries of the learner; not installed here: jax; `pip install"
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(wanted)
    assert list(where.iterdir()) == []


def test_the_examples_need_the_same_versions_as_the_package():
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    lines = (ROOT / "examples" / "requirements.txt").read_text().splitlines()
    own = lines[lines.index("# of GViZDoom itself, which is installed there without its other dependencies") + 1 :]
    assert {line for line in own if not line.startswith("pytest")} <= set(wanted)
