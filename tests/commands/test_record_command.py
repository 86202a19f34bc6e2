"""gvz record, as it is called."""

import os
import signal
import subprocess
import sys

import av
import pytest
from PIL import Image

from gvz import cli
from gvz.evaluation.episode_log import read_rows
from tests.tensorboard_events import read_events
from tests.waiting import wait_until


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--out v.webp", "want a run directory or --player"),
        ("{run} --player idle --out v.webp", "got --player idle and also "),
        ("--player idle --out v.webp", "--task: want a task id, for example defend_the_center/gore"),
        ("--player idle --task defend_the_center/gor --out v.webp", "unknown attribute 'gor' (did you mean 'gore'?)"),
        ("{run} --out v.avi", "--out: got v.avi, want a name that ends with .mp4, .gif, .webp"),
        ("--player idle --checkpoint 10 --out v.webp", "--checkpoint: got it beside --player idle, want it with a run"),
        (
            "{run} --profile levdoom --out v.webp",
            "--profile: got levdoom, but small keeps the rules that it was trained by, ",
        ),
        ("{run} --encoder none.py --out v.webp", "--encoder: no file none.py here ("),
        ("{run} --out {file}/v.webp", "cannot be written: File exists; give a place"),
        ("{run} --out v.webp --seconds 0", "--seconds: got 0, want more than 0"),
        ("{run} --out v.webp --seconds nan", "--seconds: got nan, want more than 0"),
        ("{run} --out {tmp_path}/d.webp", "d.webp is a directory; want the name of a file"),
        ("{run} --out v.webp --episode -1", "--episode: got -1, want a number from 0 to"),
        ("{run} --out v.webp --seed -1", "--seed: got -1, want a number from 0 to"),
        ("{run} --out v.webp --checkpoint 30", "--checkpoint: got '30', want newest, or one of those in "),
        ("{run} --out v.webp --checkpoint all", "policies: 10, 20"),
        ("{run} --out v.webp --task seek_and_kill/blue", "which has other buttons"),
        ("{file} --out v.webp", "is not a run directory"),
        ("{run} --out v.webp --tensorboard", "--tensorboard: want a run directory and an --out that ends with .gif"),
        ("--player idle --task seek_and_kill/blue --out v.gif --tensorboard", "--tensorboard: want a run directory"),
    ],
)
def test_bad_input_gives_one_message_and_exit_code_2(arguments, message, refusal, tmp_path, small_run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "d.webp").mkdir()
    places = {"file": tmp_path / "file", "run": small_run, "tmp_path": tmp_path}
    assert message in refusal("record", *(word.format(**places) for word in arguments.split()))
    assert not (tmp_path / "v.webp").exists()


@pytest.mark.engine
def test_a_recording_ends_with_the_score_that_was_evaluated(small_run, tmp_path, capsys):
    task = "defend_the_center/complete"
    assert cli.main(f"evaluate {small_run} --tasks {task} --episodes 1 --seeds 7 --workers 1".split()) == 0
    [row] = read_rows(small_run / "evaluation.jsonl")
    capsys.readouterr()
    video = tmp_path / "video.mp4"
    assert cli.main(f"record {small_run} --task {task} --seed 7 --out {video}".split()) == 0
    tics, score = row["length_frames"], row["score"]
    how = "died" if row["terminated"] else "reached the time-out"
    assert capsys.readouterr().out == f"{video}: small/seed_7@20 {how} at tic {tics}, score {score:g}\n"
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        assert (stream.average_rate, stream.frames) == (35, 1 + tics + round(1.5 * 35))


@pytest.mark.engine
def test_an_animation_shows_every_decision_of_the_seconds_asked_for(tmp_path, capsys):
    video = tmp_path / "video.webp"
    assert cli.main(f"record --player random --task seek_and_kill/red --seconds 1 --out {video}".split()) == 0
    assert capsys.readouterr().out.endswith("random was cut off at tic 35, score 0\n")
    with Image.open(video) as animation:
        assert animation.n_frames == 1 + 9  # the start, and the decisions of tics 1, 5, .. 33


@pytest.mark.engine
def test_tensorboard_gets_the_animation_at_the_policys_gradient_step(small_run, tmp_path):
    video = tmp_path / "video.gif"
    arguments = f"record {small_run} --checkpoint 10 --seconds 1 --out {video} --tensorboard"
    assert cli.main(arguments.split()) == 0
    events = read_events(small_run / "tensorboard" / "episodes")
    [(step, value)] = [(event.step, value) for event in events for value in event.summary.value]
    assert (step, value.tag) == (10, "episode/defend_the_center/default")
    assert value.image.encoded_image_string == video.read_bytes()
    with Image.open(video) as animation:
        assert animation.n_frames == 1 + 9
        assert animation.size == (value.image.width, value.image.height)


@pytest.mark.engine
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_an_interrupted_recording_leaves_nothing(tmp_path, number, code):
    command = [
        *(sys.executable, "-m", "gvz.cli", "record", "--player", "scripted", "--task", "defend_the_center/default"),
        *("--out", str(tmp_path / "video.mp4")),
    ]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )
    wait_until(lambda: list(tmp_path.glob(".writing-*")), "the first picture", 120, process=process)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (code, "")
    assert "interrupted; nothing was written" in err
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []
