"""What a record says of its machine is true of this one, and says nothing it does not know."""

import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import psutil
import pytest

from gvz.core import control_groups
from gvz.core.control_groups import num_cores
from gvz.run import machine

PIPES = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}


def git(directory: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    command = ["git", "-C", str(directory), *identity, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout.strip()


@pytest.fixture
def checkout(tmp_path, monkeypatch) -> Path:
    """A repository with a commit, in place of this one."""
    (tmp_path / "gvz").mkdir()
    (tmp_path / "gvz" / "env.py").write_text("1\n")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "-m", "first")
    monkeypatch.setattr(machine, "ROOT", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("group", "own_groups", "files"),
    [
        ("job", "0::/job/step\n", ("memory.max", "memory.current", "")),
        ("cpu,memory/job", "4:cpu,memory:/job/step\n", ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_")),
        ("memory/job", "4:memory:/job/step\n0::/\n", ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_")),
        ("", "0::/\n", ("memory.max", "memory.current", "")),  # within a container
        ("memory", "4:memory:/docker/1f\n", ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_")),
    ],
)
def test_memory_has_the_limits_of_containers_and_batch_jobs(tmp_path, monkeypatch, group, own_groups, files):
    limit, used, prefix = files
    (tmp_path / "listed").write_text(own_groups)
    monkeypatch.setattr(control_groups, "LISTED", tmp_path / "listed")
    monkeypatch.setattr(control_groups, "MOUNTED", tmp_path)
    directory = tmp_path / group
    (directory / "step").mkdir(parents=True)
    (directory / limit).write_text("3000000\n")
    (directory / used).write_text("2500000\n")
    (directory / "memory.stat").write_text(f"anon 1\n{prefix}inactive_file 400000\n{prefix}active_file 30000\n")
    (directory / "step" / limit).write_text("max\n" if limit == "memory.max" else f"{2**63 - 4096}\n")
    (directory / "step" / used).write_text("2500000\n")
    (directory / "step" / "memory.stat").write_text("")
    assert machine.available_memory() == 930_000
    monkeypatch.setattr(control_groups, "MOUNTED", tmp_path / "none")
    assert 930_000 < machine.available_memory() <= psutil.virtual_memory().total


def test_all_of_it_is_json_and_of_this_machine():
    found = json.loads(json.dumps(machine.describe()))
    assert set(found) == {"cpu", "cores", "memory_bytes", "system", "devices", "versions", "commit"}
    assert found["cpu"] in Path("/proc/cpuinfo").read_text()
    assert found["cores"] == num_cores()
    assert found["versions"]["jax"] == version("jax")
    assert found["devices"]


@pytest.mark.parametrize(
    ("cpuinfo", "xla_flags", "wanted"),
    [
        ("processor : 0\nflags\t\t: fpu sse4_2 avx avx2 fma\n", "", "AVX2"),
        ("flags : sse4_2 avx avx2 avx512f avx512_vnni avx512_bf16", "--xla_dump_to=x", "AVX512_BF16"),
        (
            "flags : sse4_2 avx avx2 avx512f",
            "--xla_cpu_max_isa=AVX2 --xla_cpu_max_isa=SSE4_2",
            "AVX512, at most SSE4_2 by XLA_FLAGS",
        ),
        ("Features : fp asimd", "", os.uname().machine),
    ],
)
def test_the_instruction_set_is_the_largest_that_xla_knows_and_its_cap_is_told(
    cpuinfo, xla_flags, wanted, tmp_path, monkeypatch
):
    (tmp_path / "cpuinfo").write_text(cpuinfo)
    monkeypatch.setattr(machine, "PROC", tmp_path)
    monkeypatch.setenv("XLA_FLAGS", xla_flags)
    assert machine.instruction_set() == wanted


def test_processor_time_is_that_of_this_process_of_living_children_and_of_those_waited_for():
    before_s = machine.processor_s()
    burn = "import time\nwhile time.process_time() < 0.5: pass"
    subprocess.run([sys.executable, "-c", burn], check=True)
    ended_s = machine.processor_s()
    assert ended_s >= before_s + 0.45
    living = subprocess.Popen([sys.executable, "-c", f"{burn}\nprint(flush=True)\ninput()"], **PIPES)
    try:
        assert living.stdout is not None
        living.stdout.readline()
        assert machine.processor_s() >= ended_s + 0.45
    finally:
        living.communicate("\n")
    assert machine.processor_s() >= ended_s + 0.45


def test_packages_that_are_not_installed_have_no_version():
    assert set(machine.versions(["numpy", "no-such-package"])) == {"python", "numpy"}


def test_a_commit_says_when_measured_files_differ_from_it(checkout):
    head = git(checkout, "rev-parse", "--short=12", "HEAD")
    (checkout / "notes.txt").write_text("not measured")
    assert machine.commit() == head
    (checkout / "gvz" / "new.py").write_text("")  # not even known to git
    assert machine.commit() == f"{head}+changes"


def test_an_installation_inside_of_another_repository_has_no_commit(checkout, monkeypatch):
    monkeypatch.setattr(machine, "ROOT", checkout / "gvz")
    assert machine.commit() is None


def test_a_checkout_without_git_or_without_commits_has_no_commit(checkout, monkeypatch, tmp_path_factory):
    empty = tmp_path_factory.mktemp("empty")
    git(empty, "init", "--quiet")
    monkeypatch.setattr(machine, "ROOT", empty)
    assert machine.commit() is None
    monkeypatch.setattr(machine, "ROOT", checkout)
    monkeypatch.setenv("PATH", str(empty))
    assert machine.commit() is None
