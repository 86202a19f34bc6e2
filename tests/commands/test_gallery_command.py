"""gvz gallery, as it is called."""

import os
import signal
import subprocess
import sys

import psutil
import pytest

from gvz.core import janitor
from tests.processes import arguments
from tests.waiting import wait_until


@pytest.mark.engine
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_gallery_leaves_nothing(tmp_path, number):
    places = {"TMPDIR": tmp_path / "tmp", "GVZ_RUNTIME_DIR": tmp_path / "run"}
    for place in places.values():
        place.mkdir(mode=0o700)
    process = subprocess.Popen(
        [sys.executable, "-m", "gvz.cli", "gallery", "--scenario", "defend_the_center", "--out", str(tmp_path / "out")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **{name: str(place) for name, place in places.items()}},
        process_group=0,
    )

    def engines() -> list[psutil.Process]:
        return [one for one in psutil.Process(process.pid).children() if "+viz_instance_id" in arguments(one)]

    found = wait_until(engines, "an engine", 120, process=process)
    instances = [line[line.index("+viz_instance_id") + 1] for line in map(arguments, found) if line]
    os.killpg(process.pid, number)  # the whole group, as a terminal does
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (128 + number, "", "interrupted\n")
    wait_until(lambda: not any(one.is_running() for one in found), "the end of the engine")
    assert [file for instance in instances for file in janitor.SHM_DIR.glob(f"*{instance}")] == []
    assert list((tmp_path / "tmp").iterdir()) == []
    assert list((tmp_path / "run").rglob("*.json")) == []
    assert list((tmp_path / "out").iterdir()) == []
