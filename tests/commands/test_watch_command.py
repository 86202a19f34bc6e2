"""gvz watch, as it is called; SDL's dummy driver stands in for a display."""

import pytest

from gvz import cli


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--task defend_the_center/gore", "want a run directory or --player"),
        ("{run} --episodes 0", "--episodes: got 0, want at least 1"),
        ("{run} --speed 0", "--speed: got 0, want more than 0"),
    ],
)
def test_bad_input_gives_one_message_and_exit_code_2(arguments, message, refusal, small_run):
    said = refusal("watch", *(word.format(run=small_run) for word in arguments.split()))
    assert said == f"error: {message}\n"


def test_without_a_display_the_other_command_is_named(refused_without_display):
    said = refused_without_display("watch", "--player", "random", "--task", "seek_and_kill/red")
    assert "error: watch: no window can be opened, there seems to be no display ($DISPLAY); `gvz record`" in said
    assert "Traceback" not in said


@pytest.mark.engine
def test_episodes_are_shown_one_after_the_other(capsys, monkeypatch, small_run):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    assert cli.main(f"watch {small_run} --task defend_the_center/complete --episodes 2 --speed 1000".split()) == 0
    lines = capsys.readouterr().out.splitlines()[-2:]
    assert [line.partition(":")[0] for line in lines] == [
        *("defend_the_center/complete, episode 0", "defend_the_center/complete, episode 1")
    ]
