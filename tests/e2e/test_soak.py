"""The soak's short form: a run of the real command under kills, its record, and the page made of the long form's."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command import SMALL

from benchmarks import reliability, soak
from gvz.core import janitor
from gvz.core.errors import ConfigError

ROOT = Path(__file__).parent.parent.parent


def without(flags: list[str], name: str) -> list[str]:
    """The flags but for one and its value."""
    at = flags.index(name)
    return flags[:at] + flags[at + 2 :]


@pytest.mark.e2e
@pytest.mark.engine
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_actors_are_killed_and_replaced_and_nothing_is_left(tmp_path):
    times = "--minutes 0.4 --kill-every-s 8 --stretches 1 --undisturbed-minutes 0.1 --sample-s 1".split()
    flags = without(SMALL, "--log.period-updates")
    command = [sys.executable, "-m", "benchmarks.soak", *times, "--out", str(tmp_path / "soak.json"), "--", *flags]
    stranger = janitor.SHM_DIR / f"ViZDoomSMstranger{os.getpid()}"
    stranger.touch()  # what another program has left is not the run's
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    finally:
        stranger.unlink()
    assert done.returncode == 0, done.stderr
    made = reliability.read(tmp_path / "soak.json")
    assert [stretch["kind"] for stretch in made["stretches"]] == ["undisturbed", "kills", "undisturbed"]
    assert len(made["kills"]) >= 2
    assert made["faults"]["died"] == len(made["kills"])
    assert made["exit_code"] == 128 + signal.SIGTERM
    assert (made["left_behind"], made["damaged_rows"]) == ([], 0)
    assert min(made["samples"]["processes"]) >= 4, "launcher, watchdog and what one killed actor leaves playing"
    assert max(made["samples"]["processes"]) == 2 + 2 + 4
    assert min(made["samples"]["all_bytes"]) > 0
    assert made["command"].startswith("python -m benchmarks.soak --minutes 0.4 --kill-every-s 8 --stretches 1 ")
    assert 0 < soak.summary(made)["updates_per_s"] < 2
    reliability.draw(made, tmp_path / "soak.png")
    assert (tmp_path / "soak.png").stat().st_size > 0


def test_the_page_is_what_the_records_give():
    page = reliability.PAGE.read_text()
    assert reliability.write_page(page, *map(reliability.read, reliability.RECORDS)) == page


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"schema": 0}'])
def test_what_is_no_record_is_refused(tmp_path, text):
    file = tmp_path / "soak.json"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"soak\.json: .*`make soak` and `make fuzz` make them"):
        reliability.read(file)


def test_growth_is_of_the_last_fifth_and_the_price_of_kills_of_the_stretches_beside_them():
    rates = [4.0, 3.0, 4.0, 2.0, 6.0, 7.0, 8.0]
    kinds = ["undisturbed", "kills"] * 3 + ["undisturbed"]
    stretches = [{"kind": k, "updates_per_s": rate} for k, rate in zip(kinds, rates, strict=True)]
    made = {"samples": {"time_s": [*range(10)], "all_bytes": [1, 1, 9, 9, 9, 9, 9, 9, 3, 3]}, "stretches": stretches}
    assert soak.kill_ratios(json.loads(json.dumps(made))) == [0.75, 0.4, 1.0]
    assert soak.summary(json.loads(json.dumps(made))) == {"all_bytes": 3.0, "updates_per_s": 0.75}
