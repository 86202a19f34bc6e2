"""The supervised probe: its targets and scores by hand, and the whole command on real Doom, small."""

import json

import numpy as np
import pytest

from benchmarks import probe, probe_frames
from gvz.core.env_config import LABEL_CLASSES
from gvz.observation import in_sight
from gvz.tasks import named_tasks


def test_a_thing_is_in_sight_in_the_columns_that_have_two_of_its_pixels():
    labels = np.zeros((4, 10, 1), np.uint8)
    labels[0, 0, 0] = labels[2, 1, 0] = LABEL_CLASSES.index("enemy")
    labels[3, 4, 0] = LABEL_CLASSES.index("kit")  # one pixel alone
    labels[1, 8:10, 0] = LABEL_CLASSES.index("poison")
    labels[1, 5:7, 0] = LABEL_CLASSES.index("scenery")
    seen = dict(zip(probe_frames.THINGS, in_sight(labels, probe_frames.THINGS, 5).tolist(), strict=True))
    assert seen == {
        "enemy": [True, False, False, False, False],
        "projectile": [False] * 5,
        "kit": [False] * 5,
        "poison": [False, False, False, False, True],
    }
    assert in_sight(labels, ["enemy"], 3)[0].tolist() == [True, False, False], "columns need not be of one width"


def test_scores_of_a_thing_by_hand():
    true = np.array([[True, True, False, False], [False, False, False, False]])
    said = np.array([[True, False, True, False], [False, False, False, False]])
    found = probe.binary_scores(said, true)
    assert found["balanced_accuracy"] == pytest.approx((1 / 2 + 5 / 6) / 2)
    assert found["f1"] == pytest.approx(2 * 1 / (2 + 2))
    assert probe.binary_scores(said, np.zeros_like(true)) == {"balanced_accuracy": None, "f1": None}


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--scenario nowhere", "unknown scenario 'nowhere'"),
        ("--scenario seek_and_kill --encoders natur", "did you mean 'nature'"),
        ("--scenario seek_and_kill --augment shift,invert", "augment: got 'invert'"),
        ("--scenario seek_and_kill --frames 20", "--frames: got 20, want at least 400"),
        ("--scenario seek_and_kill --seeds 0", "--seeds: got 0, want at least 1"),
        ("--scenario seek_and_kill --config nosuch", "no config 'nosuch'"),
    ],
)
def test_bad_input_is_refused_before_a_frame_is_recorded(flags, message, capsys):
    assert probe.main(flags.split()) == 2
    assert message in capsys.readouterr().err


@pytest.mark.engine
@pytest.mark.timeout(300)
def test_the_probe_learns_the_script_and_scores_held_out_and_gate_frames(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(probe, "TRAINING", "train1")
    out = tmp_path / "probe.jsonl"
    flags = ["--scenario", "dodge_projectiles", "--frames", "400", "--seeds", "1", "--minutes", "0.05"]
    flags += ["--encoders", "small", "--augment", "none", "shift,contrast", "--out", str(out)]
    assert probe.main(flags) == 0
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["augment"] for row in rows] == [*["none"] * probe.NUM_LOOKS, *["shift,contrast"] * probe.NUM_LOOKS]
    first, last = rows[0], rows[probe.NUM_LOOKS - 1]
    assert last["processor_s"] >= 3.0 > first["processor_s"]
    assert last["updates"] > first["updates"]
    assert last["held_out"]["enemy_balanced_accuracy"] > 0.7, "it has learned where the enemies stand"
    assert last["held_out"]["kit_f1"] is None, "there are no kits"
    gates = [task.id for task in named_tasks("dodge_projectiles", split="gate")]
    assert [last[task]["num_frames"] for task in gates] == [33, 33, 33]
    assert last["gate"]["num_frames"] == 99
    assert {"commit", "date", "command", "machine", "versions"} <= last.keys()
    assert "dodge_projectiles small none 0:" in capsys.readouterr().out
    saved = [dict(np.load(file)) for file in (tmp_path / "cache" / "probe").iterdir()]
    (trained,) = [frames for frames in saved if len(frames["actions"]) == 400]
    assert trained["stacks"].shape == (400, 48, 84, 4)
    assert len(np.unique(trained["episodes"])) >= probe_frames.MIN_EPISODES
    assert 0 < last["held_out"]["num_frames"] <= 200
