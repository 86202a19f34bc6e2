"""gvz play, as it is called; SDL's dummy driver stands in for a display, and the test presses the keys."""

import itertools
import json

import pytest

from gvz import cli
from gvz.commands import play
from gvz.core.env_config import EnvConfig
from gvz.evaluation.dataset import read_evaluations
from gvz.evaluation.episode_log import evaluate_player
from gvz.evaluation.human import HumanPlayer
from gvz.viewer import Window

TASK = "defend_the_center/flying_enemies+stone_wall"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("defend_the_center/gor", "unknown attribute 'gor' (did you mean 'gore'?)"),
        (f"{TASK} --episodes 0", "--episodes: got 0, want at least 1"),
        (f"{TASK} --seed -1", "--seed: got -1, want a number from 0 to 2^63 - 1"),
        (f"{TASK} --seed {2**63}", f"--seed: got {2**63}, want a number from 0 to 2^63 - 1"),
        (f"{TASK} --name sweep", "--name: got 'sweep', want a name of your own, not random, idle, sweep, scripted"),
    ],
)
def test_bad_input_gives_one_message_and_exit_code_2(arguments, message, refusal):
    assert message in refusal("play", *arguments.split())


def test_without_a_display_it_says_so_and_leaves_no_file(refused_without_display):
    said = refused_without_display("play", TASK)
    assert "error: play: no window can be opened, there seems to be no display ($DISPLAY)" in said


@pytest.fixture
def pygame(monkeypatch):
    """Its event queue without a display; episodes are played as fast as the machine can, and begin at once."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    monkeypatch.setattr(play, "SPEED", 1000.0)
    import pygame

    kinds = itertools.cycle((pygame.KEYDOWN, pygame.KEYUP, None))  # of a key that no button has, for the prompt

    def show(window, frame, original=Window.show):
        if (kind := next(kinds)) is not None:
            pygame.event.post(pygame.event.Event(kind, key=pygame.K_RETURN))
        original(window, frame)

    monkeypatch.setattr(Window, "show", show)
    return pygame


def press_as_they_play(monkeypatch, pygame, events: dict[int, list[tuple[str, str]]]) -> list[int]:
    """Presses and releases keys before decisions, by their number; the actions that the player takes."""
    actions: list[int] = []

    def act(player, original=HumanPlayer.act):
        for kind, key in events.get(len(actions), ()):
            event = {"key": getattr(pygame, f"K_{key}")} if kind.startswith("KEY") else {}
            pygame.event.post(pygame.event.Event(getattr(pygame, kind), **event))
        actions.append(original(player))
        return actions[-1]

    monkeypatch.setattr(HumanPlayer, "act", act)
    return actions


class Repeater:
    """Takes the actions of a list."""

    def __init__(self, actions: list[int]):
        self._actions = actions

    def begin(self, env, observation, info, seed):
        self._next = iter(self._actions)

    def act(self):
        return next(self._next)

    def observe(self, observation, info):
        """Ignores it."""


@pytest.mark.engine
def test_a_row_is_that_of_a_player_who_takes_the_same_actions(monkeypatch, pygame, tmp_path, capsys):
    """The actions by hand: 0 nothing, 1 attack, 2 left, 3 right, 4 attack and left, 5 attack and right."""
    events = {
        1: [("KEYDOWN", "LEFT")],
        2: [("KEYDOWN", "SPACE")],
        3: [("KEYUP", "LEFT")],  # it was down since the last decision
        5: [("KEYDOWN", "d"), ("KEYDOWN", "LEFT")],
        6: [("KEYUP", "LEFT"), ("KEYDOWN", "w")],
        8: [("KEYUP", "SPACE"), ("KEYUP", "d")],
        10: [("KEYDOWN", "SPACE"), ("KEYUP", "SPACE")],
    }
    by_hand = [0, 2, 4, 4, 1, 4, 4, 5, 5, 0, 1, 0]
    actions = press_as_they_play(monkeypatch, pygame, events)
    file = tmp_path / "human.jsonl"
    assert cli.main(["play", TASK, "--out", str(file), "--episodes", "1", "--seed", "2"]) == 0
    assert actions[: len(by_hand)] == by_hand
    assert set(actions[len(by_hand) :]) == {0}
    [row] = (json.loads(line) for line in file.read_text().splitlines())
    env = EnvConfig(action_set="combinations")
    [same] = evaluate_player(
        lambda: Repeater(actions), [TASK], tmp_path / "repeated.jsonl", name="human", episodes=1, base_seed=2, env=env
    )
    assert row == same
    assert (row["player"], row["frame_skip"], row["episode"], row["base_seed"]) == ("human", 4, 0, 2)
    assert row["reward_components"]["ammo_spent"] < 0
    assert read_evaluations(file)["score"].to_list() == [row["score"]]
    assert capsys.readouterr().out.startswith(f"{TASK}, episode 0: died at tic {row['length_frames']}, score ")


@pytest.mark.engine
def test_the_next_episode_is_one_not_recorded_yet_and_a_closed_window_drops_it(monkeypatch, pygame, tmp_path, capsys):
    """Nobody presses a key: the agent dies after 220 to 330 tics, 55 to 83 decisions."""
    file, task = tmp_path / "human.jsonl", "dodge_projectiles/default"
    rules = {"profile": "thesis", "action_set": "combinations", "frame_skip": 4}
    rows = [{"player": "human", "task": task, "episode": n, "score": 1.0, "seed": 0, **rules} for n in (0, 2)]
    file.write_text("".join(json.dumps({"schema": 1, **row}) + "\n" for row in rows))
    actions = press_as_they_play(monkeypatch, pygame, {105: [("QUIT", "")]})
    assert cli.main(["play", task, "--out", str(file)]) == 0
    assert len(actions) == 106
    assert [json.loads(line)["episode"] for line in file.read_text().splitlines()] == [0, 2, 1]
    assert capsys.readouterr().out.startswith(f"{task}, episode 1: died at tic ")


@pytest.mark.engine
def test_at_every_tic_a_key_moves_the_agent_at_once(monkeypatch, pygame, tmp_path):
    tics = []
    monkeypatch.setattr(HumanPlayer, "observe", lambda _player, _observation, info: tics.append(info["episode_frames"]))
    actions = press_as_they_play(monkeypatch, pygame, {1: [("KEYDOWN", "d")], 4: [("QUIT", "")]})
    assert cli.main(["play", TASK, "--every-tic", "--out", str(tmp_path / "human.jsonl")]) == 0
    assert actions == [0, 3, 3, 3, 3]
    assert tics == [1, 2, 3, 4]
    assert (tmp_path / "human.jsonl").read_text() == ""
