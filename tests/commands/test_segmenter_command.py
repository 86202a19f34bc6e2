"""gvz segmenter, as it is called."""

import itertools
import json
import os
import shutil

import numpy as np
import pytest

from gvz import cli
from gvz.commands import segmenter
from gvz.core import control_groups
from gvz.core.errors import ConfigError, EngineError
from gvz.env import DoomEnv
from gvz.evaluation.segmentation import Labelled
from gvz.run import machine
from gvz.segmentation import SEGMENTERS


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--scenario seek_and_kil --out n.onnx", "unknown scenario 'seek_and_kil' (did you mean 'seek_and_kill'?)"),
        ("--scenario seek_and_kill --out n.pt", "--out: got n.pt, want a name that ends in .onnx"),
        ("--scenario seek_and_kill --out n.onnx --frames 0", "--frames: got 0, want at least 1"),
        ("--scenario seek_and_kill --out n.onnx --gate-frames 0", "--gate-frames: got 0, want at least 1"),
        ("--scenario seek_and_kill --out n.onnx --processor-s 0", "--processor-s: got 0, want more than 0"),
        ("--scenario seek_and_kill --out n.onnx --workers -1", "--workers: got -1, want at least 0"),
        ("--scenario seek_and_kill --out n.onnx --seed -1", "--seed: got -1, want at least 0"),
        ("--scenario seek_and_kill --out /proc/n.onnx", "/proc/n.onnx cannot be written: "),
    ],
)
def test_bad_input_gives_one_message_and_exit_code_2(arguments, message, refusal, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in refusal("segmenter", *arguments.split())
    assert not list(tmp_path.iterdir())


def test_without_onnx_it_says_so_before_anything_is_played(refusal, tmp_path, monkeypatch):
    monkeypatch.setattr(segmenter, "find_spec", lambda _: None)
    said = refusal("segmenter", "--scenario", "seek_and_kill", "--out", str(tmp_path / "n.onnx"))
    assert "pip install 'gvizdoom[segmenter]'" in said


def test_under_a_quota_xla_has_no_thread_for_each_core_of_the_machine(refusal, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    monkeypatch.setattr(control_groups, "num_cores", lambda: 1)
    monkeypatch.setenv("NPROC", "")
    monkeypatch.delenv("NPROC")

    def stopped(*_: object) -> None:
        raise ConfigError(f"NPROC {os.environ.get('NPROC')}")

    monkeypatch.setattr(machine, "describe", stopped)
    assert "NPROC 1" in refusal("segmenter", "--scenario", "seek_and_kill", "--out", str(tmp_path / "n.onnx"))


@pytest.mark.engine
def test_without_a_gradient_step_there_is_no_network_and_an_old_one_stays(capsys, tmp_path):
    file = tmp_path / "mine.onnx"
    file.write_text("old")
    flags = (
        f"--scenario health_gathering --training-set train4 --out {file} --frames 1 --gate-frames 1 --processor-s 0.01"
    )
    assert cli.main(["segmenter", *flags.split()]) == 2
    assert "--processor-s: got 0.01, but the games alone took " in capsys.readouterr().err
    assert [(path, path.read_text()) for path in tmp_path.iterdir()] == [(file, "old")]


def test_a_network_that_was_not_scored_has_no_record_of_the_one_before_it(capsys, tmp_path, monkeypatch):
    def frames(task, number):
        if task.level == 2:
            raise EngineError("the engine died on a gate task")
        shape = (number, 144, 256)
        return Labelled(np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.uint8), np.zeros(shape, np.uint8))

    monkeypatch.setattr("gvz.evaluation.segmentation.labelled_frames", frames)
    monkeypatch.setattr("learner.segmentation.train_segmentation", lambda *_: (None, 1, 0.5))
    shipped = SEGMENTERS / "seek_and_kill.onnx"
    monkeypatch.setattr("learner.segmentation.write_onnx", lambda *given: shutil.copy(shipped, given[1]))
    file = tmp_path / "mine.onnx"
    file.with_suffix(".json").write_text("of an older network")
    assert cli.main(["segmenter", "--scenario", "seek_and_kill", "--out", str(file), "--frames", "1"]) != 0
    assert "the engine died on a gate task" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.engine
@pytest.mark.parametrize("workers", [0, 2])
def test_a_network_is_trained_scored_and_played_with(workers, capsys, tmp_path, monkeypatch):
    clock = itertools.count(0.0)
    monkeypatch.setattr(machine, "processor_s", lambda: next(clock))  # a second passes between two looks
    file = tmp_path / "new" / "mine.onnx"
    flags = f"--scenario health_gathering --training-set train4 --out {file} --frames 20 --gate-frames 60"
    flags += f" --workers {workers}"
    assert cli.main([*"segmenter --processor-s 2".split(), *flags.split()]) == 0
    out, _ = capsys.readouterr()
    record = json.loads(file.with_suffix(".json").read_text())
    names = ("default", "lava", "obstacles", "stimpacks")
    assert sorted(record["tasks"]) == [f"health_gathering/{name}" for name in names]
    assert record["gradient_steps"] == 20, "it looks after each 20"
    assert len(record["average_precision"]) == 4, "gate tasks"
    for task, found in record["average_precision"].items():
        assert task in out
        assert 0 < found["kit"] <= 1
    env = DoomEnv("health_gathering/water", frames="segmented", segmenter=str(file), frame_height=24, frame_width=42)
    frame, _ = env.reset(seed=1)
    assert frame.shape == (24, 42, 3)
    env.close()
