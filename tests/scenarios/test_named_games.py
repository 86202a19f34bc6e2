"""Named tasks play the games that the committed scores are of, and later scenarios' attributes change running games."""

import dataclasses
import hashlib
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

import pytest

from gvz.env import DoomEnv
from gvz.scenarios.base import Attribute, Content, Scenario, Task, Thing
from gvz.scenarios.compiler import map_source
from gvz.tasks import all_scenarios, named_tasks
from gvz.wad.acs.lexer import tokenize
from gvz.wad.udmf import UdmfMap, make_thing
from tests.episodes import fingerprint
from tests.scenarios.measure import Player

PROFILES = ("thesis", "levdoom")


def rules(scenario: Scenario) -> Iterable[object]:
    """What a scenario's tasks have in common."""
    yield scenario.timeouts, scenario.upper_bounds, scenario.metric, scenario.game_variables, scenario.render_weapon
    yield scenario.buttons, scenario.combination_buttons
    yield from (sorted(scenario.reward_weights(profile=profile).items()) for profile in PROFILES)


def game_digest(scenario: Scenario) -> str:
    """Of the rules and all maps, but for comments and blanks in scripts."""
    digest = hashlib.sha256(repr(list(rules(scenario))).encode())
    for task in named_tasks(scenario.id):
        for profile in PROFILES:
            source = map_source(task, profile)
            script = [token.text for token in tokenize(source.script) if token.text != str(source.map_magic)]
            digest.update(repr((task.id, profile, source.textmap, source.decorate, source.textures, script)).encode())
    return digest.hexdigest()[:16]


def test_named_tasks_are_the_games_that_scores_were_measured_in():
    """If one changes, its records are of another game: measure them again, and say so in the changelog."""
    assert {one.id: game_digest(one) for one in all_scenarios().values()} == {
        "defend_the_center": "c218d140bfd5c5f0",
        "dodge_projectiles": "e2c8f274bb16151a",
        "find_ammunition": "a8db7dff4c88cf09",
        "find_the_key": "b7c231e652c36e50",
        "guarded_goal": "a2037c0eecbe74e2",
        "health_gathering": "a920849c56fa69bb",
        "rockets": "66fbd06f8a165b76",
        "seek_and_kill": "3b8cbd3bba18b4ac",
    }


@pytest.mark.engine
@pytest.mark.parametrize(
    ("scenario", "tid", "speed", "style", "scales", "damage_factor"),
    [
        ("find_ammunition", 1000, 8.0, 65, (0.3, 3.0), 0.25),
        ("find_the_key", 110, 0.0, 65, (1.0, 5.0), 1.0),
        ("guarded_goal", 110, 0.0, 68, (0.75, 3.0), 0.4),
        ("rockets", 100, 15.0, 65, (0.3, 3.0), 1.0),
    ],
)
def test_complete_changes_the_first_thing_and_the_agent_as_its_page_says(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    scenario: str,
    tid: int,
    speed: float,
    style: int,
    scales: tuple[float, float],
    damage_factor: float,
):
    monkeypatch.chdir(tmp_path)
    player = Player(f"{scenario}/complete", "thesis")
    with closing(player.game):
        heights, sizes = set[float](), set[float]()
        for seed in range(4):
            player.restart(seed)
            player.step()
            thing, agent = player.properties(tid), player.properties(0)
            assert (thing["speed"], thing["render_style"]) == (speed, style)
            sizes |= {thing["scale_x"], thing["scale_y"]}
            assert agent["damage_factor"] == pytest.approx(damage_factor, abs=1e-4)
            heights.add(agent["view_height"])
    assert len(sizes) == 8
    assert scales[0] - 1e-4 <= min(sizes) < max(sizes) <= scales[1]
    assert heights == {41.0} if scenario == "find_ammunition" else len(heights) == 4
    assert 0 <= min(heights) <= max(heights) <= 100


@pytest.mark.engine
@pytest.mark.parametrize(
    "content",
    [
        Content(parameters={"classes": ("Spectre",)}),
        Content(entity={"RenderStyle": "STYLE_OptFuzzy"}),
        Content(parameters={"classes": ("Ghost",)}, actors={"Ghost": "ACTOR Ghost : Demon { RenderStyle Fuzzy }"}),
        Content(things={"defend_the_center.wad": (Thing(58, 300, 300),)}),
    ],
)
def test_an_attribute_of_ones_own_with_spectres_replays_its_episodes(content: Content):
    """The engine's fuzz effect continues from episode to episode, so each needs a fresh engine."""
    centre = all_scenarios()["defend_the_center"]
    ghosts = Attribute(name="ghosts", groups=("ghosts",), content=content)
    assert_replayed(Task(dataclasses.replace(centre, attributes=(*centre.attributes, ghosts)), ("ghosts",)))


@pytest.mark.engine
def test_a_map_of_ones_own_with_a_spectre_replays_its_episodes():
    def draw_spectre(drawn: UdmfMap) -> None:
        drawn.things.append(make_thing(58, 300, 300))

    assert_replayed(Task(dataclasses.replace(all_scenarios()["defend_the_center"], draw_map=draw_spectre)))


def assert_replayed(task: Task) -> None:
    with closing(DoomEnv(task)) as env:
        assert fingerprint(env, 7) == fingerprint(env, 7)
