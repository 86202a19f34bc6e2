"""The picture of a moment: what is where, in which size."""

import dataclasses

import numpy as np
import pytest

from gvz.actions import action_buttons, action_mask
from gvz.core.env_config import EnvConfig
from gvz.evaluation.panel import ACCENT, BAR, FOOT_HEIGHT, GOOD, HEAD_HEIGHT, HEIGHT, WIDTH, Panel
from gvz.evaluation.playback import SCREEN_HEIGHT, SCREEN_WIDTH, Moment
from gvz.evaluation.trained import Values
from gvz.tasks import named_tasks, parse_task, scenarios

TASK = parse_task("seek_and_kill/red")
SCREEN = np.random.default_rng(0).integers(0, 60, (SCREEN_HEIGHT, SCREEN_WIDTH, 3), np.uint8)
START = Moment(
    screen=SCREEN,
    decided=True,
    action=None,
    values=None,
    reward=0.0,
    reward_components=dict.fromkeys(TASK.scenario.rewards, 0.0),
    score=0.0,
    frames=0,
    terminated=False,
    truncated=False,
)


def values(q_values, peak_atom: int = 25) -> Values:
    masses = np.full((len(q_values), 51), 0.01)
    masses[:, peak_atom] = 0.5
    q, atoms = np.array(q_values, np.float32), np.linspace(-5, 5, 51)
    return Values(q_values=q, probabilities=masses, atoms=atoms, policy=None, value=float(q.max()))


def policy(probabilities, value: float | None = None) -> Values:
    return Values(q_values=None, probabilities=None, atoms=None, policy=np.array(probabilities), value=value)


def draw(*moments: Moment, action_set="buttons") -> np.ndarray:
    """uint8[H, W, 3] of the last moment."""
    panel = Panel("somebody/seed_1@200000", TASK, EnvConfig(action_set=action_set))
    pictures = [np.array(panel.draw(moment)) for moment in moments]
    assert pictures[-1].shape == (HEIGHT, WIDTH, 3)
    return pictures[-1]


def count(picture: np.ndarray, colour, rows=slice(None), columns=slice(None)) -> int:
    return int((picture[rows, columns] == colour).all(axis=-1).sum())


SIDE = slice(SCREEN_WIDTH, WIDTH)
GAME = slice(HEAD_HEIGHT, HEAD_HEIGHT + SCREEN_HEIGHT)


def test_both_sides_are_even_as_video_wants_them():
    assert (WIDTH % 2, HEIGHT % 2) == (0, 0)


def test_the_screen_is_shown_as_it_is():
    np.testing.assert_array_equal(draw(START)[GAME, :SCREEN_WIDTH], SCREEN)


def test_the_end_of_an_episode_is_said_on_the_screen():
    for end in ({"terminated": True}, {"truncated": True}):
        assert count(draw(dataclasses.replace(START, **end)), ACCENT, GAME, slice(SCREEN_WIDTH)) > 100
    assert count(draw(START), ACCENT, GAME, slice(SCREEN_WIDTH)) == 0


def test_the_better_the_held_action_the_longer_its_bar():
    lengths = [
        count(draw(dataclasses.replace(START, action=2, values=values([0.0, 1.0, q, 0.0, 0.0]))), ACCENT, columns=SIDE)
        for q in (0.2, 0.5, 0.9)
    ]
    assert lengths[0] + 500 < lengths[1] < lengths[2] - 500


def test_bars_keep_their_scale_through_an_episode():
    first = dataclasses.replace(START, action=0, values=values([-1.0, 3.0, 0.0, 0.0, 0.0]))
    second = dataclasses.replace(first, frames=1, values=values([0.0, 0.0, 0.0, 0.0, 0.0]))
    after, alone = count(draw(first, second), BAR, columns=SIDE), count(draw(second), BAR, columns=SIDE)
    assert after != alone


def test_the_bar_of_an_action_is_as_long_as_it_is_likely():
    """Of a policy without action values; two bars of a half are as long as one of a whole."""

    def bars(*probabilities: float) -> int:
        return count(draw(dataclasses.replace(START, action=None, values=policy(probabilities))), BAR, columns=SIDE)

    none = bars(0.0, 0.0, 0.0, 0.0, 0.0)
    whole, halves = bars(1.0, 0.0, 0.0, 0.0, 0.0) - none, bars(0.5, 0.5, 0.0, 0.0, 0.0) - none
    assert whole == pytest.approx(halves, rel=0.05)
    assert whole > 2000


def test_what_the_scenario_forbids_is_no_choice():
    """Health Gathering does not shoot, for one."""
    task = parse_task("health_gathering/lava")
    allowed = np.array(action_mask(task.scenario, "unified_v1"))

    def picture(forbidden: float) -> np.ndarray:
        estimates = dataclasses.replace(values(np.where(allowed, 1.0, forbidden)), value=1.0)
        panel = Panel("somebody", task, EnvConfig(action_set="unified_v1"))
        moment = dataclasses.replace(START, action=int(allowed.argmax()), values=estimates)
        return np.array(panel.draw(moment))

    assert 1 < allowed.sum() < len(allowed)
    np.testing.assert_array_equal(picture(-5.0), picture(9.0))


def test_the_timeline_has_the_value_of_a_policy_and_not_its_probabilities():
    foot = slice(HEAD_HEIGHT + SCREEN_HEIGHT, HEIGHT)

    def line(*values: float) -> np.ndarray:
        moments = [
            dataclasses.replace(START, frames=300 * n, values=policy([0.2] * 5, value))
            for n, value in enumerate(values)
        ]
        return draw(*moments)[foot, :SCREEN_WIDTH]

    for values, direction in (((2.0, 1.0), 1), ((1.0, 2.0), -1)):
        rows, columns = np.nonzero((line(*values) == ACCENT).all(axis=-1))
        assert len(rows) > 100
        assert rows.max() < FOOT_HEIGHT / 2, "rewards stand below"
        assert np.corrcoef(rows, columns)[0, 1] * direction > 0.9


def test_the_tallest_bar_of_the_distribution_is_the_likeliest_return_and_a_line_the_mean():
    tops = []
    for atom in (5, 45):
        picture = draw(dataclasses.replace(START, action=0, values=values([0.2 * atom - 5.0] * 5, atom)))
        below_actions = picture[HEAD_HEIGHT + 22 + 5 * 24 + 12 :, SIDE]
        at, line = (np.argwhere((below_actions == colour).all(axis=-1)) for colour in (BAR, ACCENT))
        tops.append(at[at[:, 0].argmin(), 1] / (WIDTH - SCREEN_WIDTH))
        (bar, mean) = (found[found[:, 0] == at[:, 0].min() + 5, 1] for found in (np.concatenate([at, line]), line))
        assert (bar.min() + bar.max()) / 2 == pytest.approx(mean.mean(), abs=1.5)
    assert tops == pytest.approx([5 / 51, 45 / 51], abs=0.06)


def test_without_values_there_are_neither_bars_nor_a_distribution():
    picture = draw(dataclasses.replace(START, action=1))
    assert count(picture, BAR) == 0
    assert 20 < count(picture, ACCENT, columns=SIDE) < 100, "the mark at the held action"


def test_the_foot_says_the_score_and_its_share_of_the_bound(monkeypatch):
    said = []
    monkeypatch.setattr(Panel, "_text", lambda *text: said.append(text[2]))
    draw(dataclasses.replace(START, score=5.0, frames=70))
    assert {"5", "of 20 kills", "25.0 %    tic 70 of 1200"} <= set(said)


def test_a_reward_stays_on_the_timeline():
    rewarded = dataclasses.replace(START, frames=100, reward=1.0, reward_components={"kill": 1.0})
    later = dataclasses.replace(rewarded, frames=900, decided=True)
    foot = slice(HEAD_HEIGHT + SCREEN_HEIGHT, HEIGHT)
    upper = slice(foot.start, foot.start + FOOT_HEIGHT // 2 + 1)
    assert count(draw(START, rewarded, later), GOOD, foot) == count(draw(START, rewarded), GOOD, upper) > 10
    assert count(draw(START, later), GOOD, foot, slice(0, SCREEN_WIDTH // 2)) == 0


@pytest.mark.parametrize("scenario", list(scenarios()))
@pytest.mark.parametrize("action_set", ["buttons", "combinations", "unified_v1"])
def test_everything_fits_in_whatever_is_played(scenario, action_set):
    task = max(named_tasks(scenario), key=lambda task: len(task.name))
    buttons = action_buttons(task.scenario, action_set)
    env = EnvConfig(action_set=action_set, profile="levdoom")
    panel = Panel("a_configuration_with_a_long_name/seed_3333@1000000", task, env)
    components = dict.fromkeys(task.scenario.rewards, -123.45)
    picture = np.array(
        panel.draw(
            dataclasses.replace(
                START, action=len(buttons) - 1, values=values(np.arange(len(buttons))), reward_components=components
            )
        )
    )
    edge = picture[:, -8:]
    assert (edge == edge[0, 0]).all(), "nothing runs out on the right"
    assert (picture[-4:] == edge[0, 0]).all(), "nothing runs out at the bottom"
