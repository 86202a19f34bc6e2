"""The doctor finds what is really wrong, and says how to mend it."""

import shutil
from collections import namedtuple
from pathlib import Path

import psutil
import pytest

from gvz.run import doctor

Usage = namedtuple("Usage", "total used free")  # shutil.disk_usage's own shape


@pytest.mark.engine
@pytest.mark.timeout(900)  # it compiles a learner, starts an engine, and others may be busy
def test_this_machine_is_fit():
    findings = [check() for check in doctor.CHECKS]
    assert [f for f in findings if f.state == "bad"] == []
    assert [f.name for f in findings] == [
        *("system", "python", "packages", "cores", "memory", "/dev/shm", "tmp", "cache", "leftovers"),
        *("vizdoom", "jax", "learner", "video"),
    ]


def test_little_shared_memory_is_bad_and_the_remedy_is_large_enough(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(2**26, 0, 2**26))
    finding = doctor.check_shared_memory()
    assert finding.state == "bad"
    assert finding.found.startswith("67 MB free, want ")
    size = int(finding.remedy.partition("--shm-size=")[2].partition("m")[0])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(0, 0, size * 2**20))
    assert doctor.check_shared_memory().state == "ok"


def test_little_memory_is_bad(monkeypatch: pytest.MonkeyPatch):
    free = namedtuple("Memory", "available")(10**8)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    finding = doctor.check_memory()
    assert finding.state == "bad"
    assert finding.found.startswith("100 MB available")


def test_a_cache_that_cannot_be_written_is_bad(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path / "file" / "below"))
    finding = doctor.check_cache()
    assert (finding.state, finding.remedy) == ("bad", "set GVZ_CACHE_DIR to a directory you can write to")
    assert "Not a directory" in finding.found


def test_one_core_is_worth_a_note(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "num_cores", lambda: 1)
    assert doctor.check_cores().state == "note"


def test_an_engine_that_cannot_play_is_bad_and_its_last_words_are_shown(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "_ENGINE", "raise RuntimeError('no such library')")
    finding = doctor.check_engine()
    assert finding.state == "bad"
    assert finding.found.endswith(": exit code 1: RuntimeError: no such library")


def test_a_device_that_kills_the_process_is_bad(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "_DEVICES", "import os; os.kill(os.getpid(), 11)")
    finding = doctor.check_devices()
    assert (finding.state, finding.found) == ("bad", "exit code -11 (SIGSEGV): no message")


def test_why_jax_fails_is_said(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("JAX_PLATFORMS", "abacus")
    assert ": JAX_PLATFORMS=abacus: JAX finds no such devices (" in doctor.check_devices().found
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.setattr(doctor, "_DEVICES", "import jax.numpy; jax.numpy.ones(2) + jax.numpy.ones(3)")
    assert doctor.check_devices().found.startswith("exit code 1: TypeError: ")


def test_one_that_does_not_answer_is_bad(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "_TRY_TIMEOUT_S", 1)
    monkeypatch.setattr(doctor, "_DEVICES", "import time; time.sleep(60)")
    assert doctor.check_devices().found == "no answer within 1 s"


def test_a_learner_that_computes_something_else_is_bad_and_its_instruction_set_is_named(
    monkeypatch: pytest.MonkeyPatch,
):
    wrong = "raise ValueError('self-check: loss of update 1 is 4, want 3')"
    monkeypatch.setattr(doctor, "_LEARNER", wrong)
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_max_isa=AVX2")
    finding = doctor.check_learner()
    assert finding.state == "bad"
    assert finding.found.endswith(
        ", at most AVX2 by XLA_FLAGS: exit code 1: ValueError: self-check: loss of update 1 is 4, want 3"
    )
