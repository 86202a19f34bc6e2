"""The number of cores follows the quota of a container or batch job."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from gvz.core import control_groups
from gvz.core.control_groups import num_cores, some_cores


@pytest.fixture(autouse=True)
def sixty_four_cores(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)))
    control_groups._quotas.cache_clear()
    yield
    control_groups._quotas.cache_clear()


@pytest.mark.parametrize(
    ("group", "listed"),
    [
        ("", "0::/\n"),  # within a container
        ("kubepods/pod1", "0::/kubepods/pod1/main\n"),
        ("cpu,cpuacct", "4:cpu,cpuacct:/docker/1f\n0::/\n"),
        ("cpu/slurm/job_1", "3:cpuset:/\n4:cpu:/slurm/job_1/step_0\n"),
    ],
)
@pytest.mark.parametrize(("quota", "cores"), [(150_000, 2), (10_000, 1), (400_000, 4), (9_900_000, 64), (None, 64)])
def test_a_quota_of_processor_time_is_worth_so_many_cores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, group: str, listed: str, quota: int | None, cores: int
):
    (tmp_path / "listed").write_text(listed)
    monkeypatch.setattr(control_groups, "LISTED", tmp_path / "listed")
    monkeypatch.setattr(control_groups, "MOUNTED", tmp_path)
    directory = tmp_path / group
    directory.mkdir(parents=True, exist_ok=True)
    if group.startswith("cpu"):
        (directory / "cpu.cfs_quota_us").write_text(f"{-1 if quota is None else quota}\n")
        (directory / "cpu.cfs_period_us").write_text("100000\n")
    else:
        (directory / "cpu.max").write_text(f"{'max' if quota is None else quota} 100000\n")
    assert num_cores() == cores
    monkeypatch.setattr(control_groups, "MOUNTED", tmp_path / "none")
    assert num_cores() == cores, "read once: the configurations of all experiments ask 3,000 times"
    control_groups._quotas.cache_clear()
    assert num_cores() == 64


def test_with_a_quota_jobs_share_so_many_cores_from_a_random_place(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(control_groups, "num_cores", lambda: 64)
    assert some_cores() == list(range(64))
    monkeypatch.setattr(control_groups, "num_cores", lambda: 4)
    monkeypatch.setattr(control_groups.random, "randrange", lambda _: 62)
    assert some_cores() == [0, 1, 62, 63]
