"""The reference scores: records are whole, and the docs say what they and the code say."""

import gzip
import itertools
import json
import runpy
import sys
from collections import defaultdict

import numpy as np
import pytest

import benchmarks.reference
from benchmarks.reference import (
    COMMAND,
    PAGE,
    PLAYERS,
    RECORDS,
    estimate,
    pack,
    pages,
    read_reference,
)
from benchmarks.report import between
from gvz.core.errors import ConfigError
from gvz.evaluation.play import episode_seed
from gvz.experiments.base import experiment_named
from gvz.tasks import all_scenarios, named_tasks, scenarios
from tests.score_tables import ROOT, rows_of, words_of

SCORES = read_reference()
WORDS = " ".join(PAGE.read_text().split())


@pytest.mark.parametrize("player", PLAYERS)
def test_every_task_has_its_hundred_episodes(player):
    for task in named_tasks():
        rows = SCORES[player, task.id]
        assert [row["episode"] for row in rows] == list(range(100)), task.id
        assert all(row["seed"] == episode_seed(task.id, row["episode"]) for row in rows)
        assert all(row["profile"] == "thesis" for row in rows)


def test_no_score_is_above_its_bound():
    for task in named_tasks():
        bound = task.scenario.upper_bound("thesis")
        for row in (row for player in PLAYERS for row in SCORES[player, task.id]):
            if task.scenario.metric == "kills":
                assert row["score"] == min(row["kills"], bound)
                assert row["player_kills"] <= row["kills"]
            else:
                assert 0 < row["score"] <= bound


def test_the_tables_of_the_pages_are_what_the_records_give():
    for page, text in pages().items():
        assert page.read_text() == text


@pytest.mark.parametrize("scenario", scenarios("extended"))
def test_records_of_later_scenarios(scenario):
    """Every row follows from task and episode, and no score is above the bound."""
    bound = all_scenarios()[scenario].upper_bound("thesis")
    for (_, task), rows in read_reference(RECORDS / scenario).items():
        assert [row["episode"] for row in rows] == list(range(100)), task
        assert all(row["seed"] == episode_seed(task, row["episode"]) for row in rows)
        assert all(0 <= row["score"] <= bound for row in rows)


def mean(player: str, task: str, column: str = "score") -> float:
    return float(np.mean([row[column] for row in SCORES[player, task]]))


def percent(player: str, *tasks: str) -> float:
    bound = scenarios()[tasks[0].partition("/")[0]].upper_bound("thesis")
    return float(np.mean([100 * mean(player, task) / bound for task in tasks]))


def test_the_sweep_of_dodge_projectiles_and_the_script_played_the_same_episodes():
    for task in named_tasks("dodge_projectiles"):
        sweep, scripted = (
            [(row["seed"], row["score"], row["reward"], row["terminated"]) for row in SCORES[player, task.id]]
            for player in ("sweep", "scripted")
        )
        assert sweep == scripted, task.id


def test_the_page_says_what_a_player_without_sight_reaches():
    dtc, hg, sk, dp = "defend_the_center/default", "health_gathering", "seek_and_kill/default", "dodge_projectiles"
    test_tasks = [task.id for task in named_tasks(dp, split="test")]
    for told in (
        f"firing reaches {percent('sweep', dtc):.0f} % in `default`",
        f"that is told where enemies are reaches {percent('scripted', dtc):.0f} %",
        f"{percent('sweep', hg + '/default'):.0f} % in `default`, {percent('sweep', hg + '/lava'):.0f} % in `lava`",
        f"({percent('sweep', hg + '/supreme'):.0f} % and {percent('sweep', hg + '/poison'):.0f} %)",
        f"kills {mean('sweep', sk):.1f} of 20 in `default`",
        f"that is told where enemies are kills {mean('scripted', sk):.1f}.",
        f"reaches {percent('sweep', dp + '/default'):.0f} % in `default` and",
        f"and {percent('sweep', *test_tasks):.0f} % of the bound on the test set",
    ):
        assert told in WORDS, told


def test_the_page_says_what_players_reach_on_drawn_maps():
    page, drawn = words_of("docs/benchmark/drawn-maps.md"), defaultdict[tuple[str, str], list[float]](list)
    for player in ("random", "scripted"):
        for row in rows_of(RECORDS.parent / "drawn_maps" / f"{player}.jsonl.gz"):
            assert row["seed"] == episode_seed(row["task"], row["episode"])
            drawn[player, row["task"]].append(row["score"])
    assert {len(scores) for scores in drawn.values()} == {100}
    for name, scenario in scenarios().items():
        digits = 1 if scenario.metric == "kills" else 0
        scores = (
            mean("scripted", f"{name}/default"),
            *(np.mean(drawn["scripted", f"{name}/{maps}"]) for maps in ("varied", "procedural-train")),
            mean("random", f"{name}/default"),
            np.mean(drawn["random", f"{name}/procedural-train"]),
        )
        assert f"| {scenario.title} | {' | '.join(f'{score:.{digits}f}' for score in scores)} |" in page


def test_the_page_says_how_many_sergeants_died_by_other_hands():
    page, told = words_of("docs/EXTENDED.md"), {}
    for (player, task), rows in read_reference(RECORDS / "guarded_goal").items():
        told[player, task] = tuple(int(sum(row[name] for row in rows)) for name in ("kills", "player_kills"))
        if "sergeants" not in task:
            cut = [row["length_frames"] == 1050 for row in rows if row["kills"] != row["player_kills"]]
            assert all(cut), "only the last tic's death is not counted yet"
            assert told[player, task][0] - told[player, task][1] == len(cut), "one of each"
    random, sweep, scripted, idle = (
        told[player, "guarded_goal/sergeants"] for player in ("random", "sweep", "scripted", "idle")
    )
    assert idle == (1, 0)
    assert (
        f"With random play {random[0]} guards died, and it killed {random[1]} of them. With the sweep {sweep[0]} died "
        f"({sweep[1]} by the sweep), with the script {scripted[0]} ({scripted[1]} by the script)."
    ) in page


def test_the_page_of_later_scenarios_says_what_players_reach():
    page = words_of("docs/EXTENDED.md")

    def found(player: str, task: str, column: str = "score") -> float:
        rows = read_reference(RECORDS / task.partition("/")[0])[player, task]
        return float(np.mean([row[column] for row in rows]))

    def of_sweep(scenario: str) -> tuple[float, str]:
        """Its score in `default`, and that in percent of the bound."""
        score = found("sweep", f"{scenario}/default")
        return score, f"{100 * score / all_scenarios()[scenario].upper_bound('thesis'):.0f} %"

    key, goal, rockets, ammunition = map(of_sweep, ("find_the_key", "guarded_goal", "rockets", "find_ammunition"))
    fast = ("fast_enemies", "fast_enemies+resized_enemies+wrong_ammunition")
    deaths = [f"{100 * found('scripted', f'find_ammunition/{name}', 'terminated'):.0f}" for name in fast]
    assert round(1 / goal[0]) == 11
    for told in (
        f" blind walk in circles leaves {key[0]:.1f} times in `default`, {key[1]} of the bound",
        f"where it sees nothing and leaves {found('scripted', 'find_the_key/maze'):.1f} times",
        f"reaches a goal in one episode of eleven, {goal[1]} of the bound",
        f"until its rockets are spent kills {rockets[0]:.1f} of 45 in `default`, {rockets[1]} of the bound",
        f"Random play kills {found('random', 'rockets/default'):.0f}, some of them together with itself",
        f"burst barrels and kill {found('idle', 'rockets/complete'):.0f} enemy even if the agent does nothing",
        f"the best blind sweep kills {ammunition[0]:.1f} enemies in `default`, {ammunition[1]} of the bound",
        f"in the maze it kills {found('sweep', 'find_ammunition/maze'):.1f}.",
        f"kill it in {deaths[0]} of 100 episodes, and in {deaths[1]} if they also have other sizes",
    ):
        assert told in page, told


def test_the_page_says_where_the_thesis_is_beside_the_sweep():
    published = experiment_named("training_set_size").published["thesis"]
    above = [
        published[scenario][1] - percent("sweep", *(task.id for task in named_tasks(scenario, split="test")))
        for scenario in scenarios()
    ]
    below, least, _, most = sorted(above)
    told = f"is {least:.0f} to {most:.0f} points above the sweep in three scenarios and {-below:.0f} points below it in"
    assert told in WORDS


def test_the_page_says_how_enemies_kill_each_other_and_what_walking_earns():
    deaths = {t.name: [row["kills"] for row in SCORES["sweep", t.id]] for t in named_tasks("dodge_projectiles")}
    infighting = deaths.pop("complete")
    assert not any(map(any, deaths.values()))
    default = "seek_and_kill/default"
    earned = {player: f"{mean(player, default, 'reward'):.0f}" for player in ("sweep", "scripted")}
    own = {player: f"{mean(player, default, 'player_kills'):.1f}" for player in ("sweep", "scripted")}
    for told in (
        f"In {np.count_nonzero(infighting)} of 100 episodes of the sweep",
        f"another's missiles, {np.mean(infighting):.1f} on average",
        f"The sweep earns {earned['sweep']} in an episode of `default` with {own['sweep']} own kills",
        f"the scripted player {earned['scripted']} with {own['scripted']}",
    ):
        assert told in WORDS, told


def test_the_page_says_that_other_sizes_of_enemies_make_a_task_harder():
    names = ("blue+mixed_enemies+resized_enemies", "mixed_enemies")
    sized, plain = (percent("scripted", f"seek_and_kill/{name}") for name in names)
    assert f"`{names[0]}` has {sized:.1f}, `{names[1]}` {plain:.1f}." in WORDS


def test_the_page_says_what_the_other_mean_over_test_tasks_would_give():
    levels = [[task.id for task in named_tasks("dodge_projectiles", level=level, split="test")] for level in (2, 3, 4)]
    flat = percent("sweep", *itertools.chain(*levels))
    other = np.mean([percent("sweep", *tasks) for tasks in levels])
    assert f"has {flat:.0f} % by ours and {other:.0f} % by the other" in words_of("docs/benchmark/differences.md")


def test_an_estimate_over_tasks_is_the_mean_of_their_episodes():
    tasks = named_tasks("dodge_projectiles", level=1)
    scores = np.array([row["score"] for task in tasks for row in SCORES["scripted", task.id]])
    found = estimate(SCORES, "scripted", tasks, scale=100 / 2100)
    assert found.value == pytest.approx(scores.mean() / 21)
    assert found.low < found.value < found.high


@pytest.mark.parametrize("scenario", scenarios().values(), ids=lambda s: s.id)
def test_the_page_tells_each_scenario_as_it_is(scenario):
    page = (ROOT / "docs" / "BENCHMARK.md").read_text()
    for attribute in scenario.attributes:
        assert f"`{attribute.name}`" in page
    for name, reward in scenario.rewards.items():
        assert f"| {scenario.title} | {name} | {reward.weight:g} | {reward.levdoom:g} |" in page
    sets = {name: ", ".join(tasks) for name, tasks in scenario.splits.items()}
    level_1 = {task.name for task in named_tasks(scenario.id, level=1)}
    if {task.name for task in named_tasks(scenario.id, split="train8")} == {"default", *level_1}:
        sets["train8"] = "default and all of level 1"
    assert f"| {scenario.title} | {sets['train4']} | {sets['train8']} | {sets['test']} |" in page
    assert f"(images/gallery_{scenario.id}.png)" in page


def record(**fields) -> str:
    row = {
        "schema": 1,
        "player": "idle",
        "profile": "thesis",
        "action_set": "combinations",
        "frame_skip": 4,
        "task": "t",
        "episode": 0,
        "seed": 1,
        "score": 1.0,
        "player_kills": 0.0,
        "reward": 0.5,
        "length_frames": 4,
        "terminated": True,
        "length_steps": 1,
    }
    return json.dumps({**row, **fields}) + "\n"


def test_packing_sorts_drops_columns_and_gives_the_same_bytes(tmp_path):
    (tmp_path / "a.jsonl").write_text(record(episode=1) + record(episode=0))
    (tmp_path / "b.jsonl").write_text(record(episode=0) + record(episode=1))
    packed = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (file,) = pack(tmp_path / f"{name}.jsonl", tmp_path / name)
        assert file.name == "idle.jsonl.gz"
        packed.append(file.read_bytes())
    assert packed[0] == packed[1]
    rows = [json.loads(line) for line in gzip.decompress(packed[0]).decode().splitlines()]
    assert [row["episode"] for row in rows] == [0, 1]
    assert "length_steps" not in rows[0]


def test_what_is_no_reference_record_is_refused(tmp_path):
    file = tmp_path / "rows.jsonl"
    file.write_text(record(player="rainbow"))
    with pytest.raises(ConfigError, match="rows of rainbow; want only random, idle, sweep, scripted"):
        pack(file, tmp_path)
    file.write_text("half a li")
    with pytest.raises(ConfigError, match="line 1: not JSON"):
        pack(file, tmp_path)
    with pytest.raises(ConfigError, match="there are no records of this player"):
        read_reference(tmp_path)
    (tmp_path / "random.jsonl.gz").write_bytes(gzip.compress(record(schema=2).encode()))
    with pytest.raises(ConfigError, match="schema 2, want 1"):
        read_reference(tmp_path)


def test_a_page_without_its_markers_is_an_error():
    with pytest.raises(ConfigError, match="are missing; what is measured goes between them"):
        between("# Reference scores", PAGE, "reference scores", "tables", COMMAND)


def test_the_command_names_a_missing_file(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["reference", "missing.jsonl"])
    with pytest.raises(SystemExit, match=r"^error: missing\.jsonl: no such record file"):
        runpy.run_path(benchmarks.reference.__file__, run_name="__main__")
