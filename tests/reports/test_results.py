"""What a report reads: runs, agents and plans; what is damaged is told and the rest is there."""

import gzip
import json
import shutil
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from gvz.core.errors import ConfigError
from gvz.experiments.base import experiment_named
from gvz.experiments.inventory import run_directory
from gvz.experiments.plan import Plan
from gvz.reports.agents import EACH
from gvz.reports.results import read_results
from gvz.reports.run_section import run_sections
from gvz.reports.runs import training_time_s
from tests.reports.conftest import evaluation_row, write_rows

TRAIN4 = "runs/rainbow_4task/defend_the_center/train4"
"""where `small` has its only run on four tasks, seed_1111"""


@pytest.fixture(scope="module")
def small(tmp_path_factory, experiments_writer):
    """Runs of two experiments that share some, one seed, one scenario."""
    results = tmp_path_factory.mktemp("small")
    plan = Plan.of("training_set_size", "training_difficulty", scale=0.0001)
    experiments_writer(results, plan, lambda _: 50.0)
    return results


def test_agents_are_told_apart_by_what_they_were_trained_on(small):
    results = read_results([small])
    assert not results.problems
    assert set(results.agents.values()) == {
        *(f"rainbow_4task ({training})" for training in ("1 task", "4 tasks", "8 tasks", EACH)),
    }
    assert set(results.episodes["agent"]) == {*results.agents.values(), "random"}
    assert [asked.experiment.name for asked in results.asked] == ["training_set_size", "training_difficulty"]
    assert {asked.scale for asked in results.asked} == {0.0001}


def test_an_agent_trained_in_one_way_needs_no_more_than_its_name(small, tmp_path):
    one = small / TRAIN4
    shutil.copytree(one, tmp_path / "elsewhere")
    results = read_results([tmp_path / "elsewhere" / "seed_1111"])
    assert list(results.agents.values()) == ["rainbow_4task"]
    (run,) = results.runs
    assert (run.id, run.training, run.seed) == ("seed_1111", "4 tasks", 1111)


def test_a_run_in_a_folder_called_discarded_is_read_and_what_a_run_discarded_is_not(small, tmp_path):
    one = small / TRAIN4 / "seed_1111"
    run = tmp_path / "discarded" / "seed_1111"
    shutil.copytree(one, run)
    shutil.copytree(one, run / "discarded" / "further" / "seed_1111")
    for path in (tmp_path, tmp_path / "discarded"):
        assert [found.path for found in read_results([path]).runs] == [run]


def test_final_are_the_last_quarter_of_a_runs_checkpoints(small):
    episodes = read_results([small]).episodes
    final = episodes.filter(pl.col("final") & pl.col("run").is_not_null())
    assert set(final["num_updates"]) == {run.total_updates for run in read_results([small]).runs}  # 1 of 2
    assert episodes.filter(player="random")["final"].all()


@pytest.mark.parametrize(("num_checkpoints", "num_final"), [(4, 1), (5, 2), (8, 2)])
def test_the_last_quarter_is_rounded_up(tmp_path, num_checkpoints, num_final):
    rows = [
        evaluation_row(f"r@{n}", "seek_and_kill/default", 0, 50.0, run="r", run_seed=1, num_updates=n, params=str(n))
        for n in range(num_checkpoints)
    ]
    write_rows(tmp_path / "rows.jsonl", rows)
    final = read_results([tmp_path]).episodes.filter("final")
    assert sorted(final["num_updates"]) == list(range(num_checkpoints))[-num_final:]


def test_a_record_file_may_hold_several_runs_each_with_its_last_checkpoint(tmp_path):
    """As `gvz evaluate RUN RUN RUN --out FILE` writes it; the seeds have different numbers of gradient steps."""
    trained = [("DQN", 1, 400), ("DQN", 1, 100), ("DQN", 2, 300), ("PPO", 1, 50)]
    rows = [
        evaluation_row(f"{run}/{seed}", task, 0, 50.0, run=run, run_seed=seed, num_updates=updates, params=str(updates))
        for run, seed, updates in trained
        for task in ("seek_and_kill/default", "dodge_projectiles/default")
    ]
    write_rows(tmp_path / "all.jsonl", rows)
    final = read_results([tmp_path / "all.jsonl"]).episodes.filter("final")
    assert set(final.select("run", "run_seed", "num_updates").rows()) == {
        ("DQN", 1, 400),
        ("DQN", 2, 300),
        ("PPO", 1, 50),
    }
    assert len(final) == 6


def test_an_earlier_checkpoint_in_a_file_elsewhere_is_no_final_one(a_run, tmp_path):
    """As `gvz evaluate RUN --checkpoints N --out FILE` writes it."""
    rows = [json.loads(line) for line in (a_run / "evaluation.jsonl").read_text().splitlines()]
    newest = max(row["num_updates"] for row in rows)
    for directory, earlier in ((a_run, False), (tmp_path / "elsewhere", True)):
        kept = [row for row in rows if (row["num_updates"] < newest) == earlier]
        write_rows(directory / "evaluation.jsonl", kept)
    episodes = read_results([a_run, tmp_path / "elsewhere"]).episodes
    assert episodes.select(pl.col("num_updates").n_unique()).item() == 2
    assert set(episodes.filter("final")["num_updates"]) == {newest}


def test_an_agent_that_played_by_several_rules_is_several(tmp_path):
    task = "defend_the_center/default"
    rows = [evaluation_row(who, task, 0, 50.0, profile=rules) for who in ("a", "b") for rules in ("thesis", "levdoom")]
    write_rows(tmp_path / "rows.jsonl", rows[:3])
    assert set(read_results([tmp_path]).episodes["agent"]) == {"a (thesis)", "a (levdoom)", "b (thesis)"}
    write_rows(tmp_path / "rows.jsonl", [{**rows[2], "frame_skip": skip} for skip in (4, 8)])
    assert set(read_results([tmp_path]).episodes["agent"]) == {"b (frame_skip 4)", "b (frame_skip 8)"}


def test_agents_that_played_different_profiles_are_not_compared_without_a_word(tmp_path):
    task = "defend_the_center/default"
    rows = [evaluation_row(who, task, 0, 50.0, profile=rules) for who, rules in (("a", "thesis"), ("b", "levdoom"))]
    write_rows(tmp_path / "rows.jsonl", rows)
    assert set(read_results([tmp_path]).episodes["agent"]) == {"a (thesis)", "b (levdoom)"}


def test_players_that_observe_other_than_the_screen_have_it_in_their_names(tmp_path):
    task = "defend_the_center/default"
    rows = [evaluation_row("a", task, 0, 10.0), evaluation_row("a", task, 0, 20.0, observes="classes")]
    write_rows(tmp_path / "rows.jsonl", rows)
    shown = read_results([tmp_path]).episodes.select("agent", "normalized_score").rows()
    assert shown == [("a", 10.0), ("a (classes)", 20.0)]


def test_agents_of_different_maps_that_played_the_same_are_not_one(tmp_path, experiments_writer):
    plan = Plan.of("procedural_gap", scale=0.0001, scenarios=("defend_the_center",))
    experiments_writer(tmp_path, plan, lambda _: 50.0)
    assert len({*read_results([tmp_path]).agents.values()}) == len(experiment_named("procedural_gap").trainings)


@pytest.fixture
def copied(small, tmp_path):
    """Copies a run to `tmp_path / name`, with other settings."""

    def copy(name: str | Path, source: Path = small / TRAIN4 / "seed_1111", **settings: Any) -> None:
        shutil.copytree(source, tmp_path / name)
        saved = json.loads((tmp_path / name / "config.json").read_text())
        for field, values in settings.items():
            saved["config"][field] = saved["config"][field] | values if isinstance(values, dict) else values
        (tmp_path / name / "config.json").write_text(json.dumps(saved))

    return copy


def test_runs_of_one_configuration_with_other_settings_are_several_agents(copied, tmp_path):
    copied("a/run", agent={"discount": 0.5})
    copied("b/run", learner={"total_updates": 10**6})  # changes nothing of what the agent is
    results = read_results([tmp_path / "a", tmp_path / "b"])
    assert results.agents == {
        str(tmp_path / "a" / "run"): "rainbow_4task (agent.discount 0.5)",
        str(tmp_path / "b" / "run"): "rainbow_4task (agent.discount 0.99)",
    }
    assert not results.problems


def test_runs_that_played_where_others_were_trained_are_agents_of_their_own(tmp_path, experiments_writer):
    plan = Plan.of("general_on_policy", scale=0.0001, scenarios=("defend_the_center", "health_gathering"))
    experiments_writer(tmp_path, plan, lambda _: 50.0)
    one, other = (run_directory(tmp_path, run) for run in plan.runs())
    assert set(read_results([tmp_path]).agents.values()) == {"ppo_segmented"}
    rows = [json.loads(line) for line in (other / "evaluation.jsonl").read_text().splitlines()]
    write_rows(one / "away.jsonl", [{**row, "params": "1"} for row in rows])
    assert read_results([tmp_path]).agents == {
        str(one): "ppo_segmented (trained in defend_the_center)",
        str(other): "ppo_segmented (trained in health_gathering)",
    }


def test_a_run_that_lacks_a_setting_hides_no_difference_between_others(copied, tmp_path):
    for seed, discount in enumerate((0.5, 0.9, None)):
        copied(f"r/{seed}", seed=seed, agent={"discount": discount})
    file = tmp_path / "r" / "2" / "config.json"
    file.write_text(file.read_text().replace('"discount": null, ', ""))
    agents = read_results([tmp_path / "r"]).agents
    for seed, word in enumerate((" (agent.discount 0.5)", " (agent.discount 0.9)", "")):
        assert agents[str(tmp_path / "r" / str(seed))] == f"rainbow_4task{word}"


def test_reward_weights_tell_agents_apart_unless_they_are_of_other_scenarios(copied, tmp_path):
    for number, weights in enumerate(([], [["seek_and_kill.kill", 2.0]], [["kill", 2.0]])):
        copied(f"r/{number}", seed=number, env={"reward_weights": weights})
    agents = read_results([tmp_path / "r"]).agents
    for number, weights in enumerate(("[]", "[]", '[["kill", 2.0]]')):
        assert agents[str(tmp_path / "r" / str(number))] == f"rainbow_4task (env.reward_weights {weights})"


@pytest.mark.parametrize("experiment", ["training_set_size", "general_pairs", "general_compositions", "general"])
def test_runs_of_an_experiment_with_other_settings_are_put_together(copied, tmp_path, experiments_writer, experiment):
    plan = Plan.of(experiment, scale=0.0001, scenarios=("defend_the_center",))
    experiments_writer(tmp_path, plan, lambda _: 50.0)
    run = run_directory(tmp_path, plan.runs()[-1])
    names = {*read_results([tmp_path]).agents.values()}
    copied(other := run.with_name("seed_2222"), run, agent={"discount": 0.5}, seed=2222)
    results = read_results([tmp_path])
    assert {*results.agents.values()} == names
    (problem,) = (text for text in results.problems if text.startswith(f"{other}: put together"))
    assert " which have another agent.discount 0." in problem


def test_seeds_that_learned_with_other_networks_are_named(small, copied, tmp_path):
    shutil.copytree(small, tmp_path / "r")
    runs = tmp_path / "r" / TRAIN4
    for seed, digest in ((2222, "a"), (3333, "b")):
        copied(f"r/{TRAIN4}/seed_{seed}", seed=seed)
        starts = [{"num_updates": 0, "segmenters": {"defend_the_center": digest}}]
        write_rows(runs / f"seed_{seed}" / "starts.jsonl", starts)
    (problem,) = read_results([tmp_path / "r"]).problems
    assert problem == (
        f"{runs / 'seed_3333'}: put together with {runs / 'seed_2222'}, which learned with another segmentation "
        "network of defend_the_center"
    )


def test_seeds_of_other_budgets_are_named(copied, tmp_path):
    for seed, limit_s in enumerate((900.0, 5400.0, 900.0), 1):
        copied(f"r/{seed}", seed=seed, max_processor_s=limit_s)
    results = read_results([tmp_path / "r"])
    assert set(results.agents.values()) == {"rainbow_4task"}
    (problem,) = results.problems
    assert problem == (
        f"{tmp_path / 'r' / '2'}: put together with {tmp_path / 'r' / '1'}, which has another budget: 900 seconds of "
        "processor time, at most 20 gradient steps, not 5,400 seconds of processor time, at most 20 gradient steps"
    )


def test_a_seed_that_is_there_twice_is_named(copied, tmp_path):
    copied("a/run")
    copied("b/run")
    results = read_results([tmp_path / "a", tmp_path / "b"])
    (problem,) = results.problems
    assert problem.startswith(f"{tmp_path / 'b' / 'run'}: the same agent and training seed as {tmp_path / 'a' / 'run'}")
    assert [run.id for run in results.runs] == ["a/run", "b/run"]


def test_a_report_can_be_made_inside_a_run_directory(copied, tmp_path, monkeypatch):
    copied("run")
    monkeypatch.chdir(tmp_path / "run")
    (run,) = read_results([Path()]).runs
    assert run.id == "run"


def test_runs_on_another_disk_are_read_through_links(small, tmp_path):
    results = shutil.copytree(small, tmp_path / "results")
    seed = results / TRAIN4 / "seed_1111"
    (seed / "episode.mp4").touch()
    before, plain = read_results([results]), run_sections(read_results([results]), tmp_path)[-1]
    seed.rename(tmp_path / "elsewhere")
    seed.symlink_to(tmp_path / "elsewhere")
    (results / "runs").rename(tmp_path / "scratch")
    (results / "runs").symlink_to(tmp_path / "scratch")
    (results / "best").symlink_to(seed)
    (tmp_path / "elsewhere" / "up").symlink_to(results)
    after = read_results([results])
    assert after.episodes.equals(before.episodes)
    assert [run.path for run in after.runs] == [run.path for run in before.runs]
    assert [run.id for run in after.runs] == [run.id for run in before.runs]
    assert (after.agents, after.asked, after.problems) == (before.agents, before.asked, before.problems)
    linked = run_sections(after, tmp_path)[-1]
    assert [link.text for link in linked.blocks[0].links] == [link.text for link in plain.blocks[0].links]
    assert str(seed / "episode.mp4") in {link.text for link in linked.blocks[0].links}


@pytest.mark.parametrize("name", ["", "evaluation.jsonl"])
def test_a_run_that_is_given_beside_its_results_by_another_name_stays_in_its_experiment(small, tmp_path, name):
    run = small / TRAIN4 / "seed_1111"
    (tmp_path / "latest").symlink_to(run)
    alone, both = read_results([small]), read_results([tmp_path / "latest" / name, small])
    assert not both.problems
    assert both.agents == alone.agents
    assert [one.id for one in both.runs] == [one.id for one in alone.runs]
    assert both.episodes.equals(alone.episodes)


def test_a_plan_that_is_a_broken_link_is_told_of(tmp_path):
    (tmp_path / "plan.json").symlink_to(tmp_path / "nowhere")
    (problem,) = read_results([tmp_path]).problems
    assert problem.startswith(f"{tmp_path / 'plan.json'}: a link that leads nowhere")


def test_episodes_of_another_base_seed_are_left_out_and_counted(tmp_path):
    rows = [
        evaluation_row("random", "seek_and_kill/default", n, score, base_seed=base_seed, seed=10 * base_seed + n)
        for base_seed, score in ((0, 5.0), (1, 10.0))
        for n in range(3)
    ]
    del rows[0]["base_seed"]  # as in older rows, which are of base seed 0
    write_rows(tmp_path / "rows.jsonl", rows)
    results = read_results([tmp_path])
    assert results.episodes["normalized_score"].to_list() == [5.0] * 3
    (problem,) = results.problems
    assert problem.startswith("3 evaluation episodes of other base seeds than 0 are left out")


def test_damaged_runs_and_plans_are_named_and_the_rest_is_read(small, tmp_path):
    shutil.copytree(small, tmp_path / "r")
    runs = sorted((tmp_path / "r" / "runs").rglob("config.json"))
    runs[0].write_text("{")
    (runs[1].parent / "evaluation.jsonl").unlink()
    with (runs[2].parent / "episodes.jsonl").open("a") as stream:
        stream.write('{"half')
    (tmp_path / "r" / "plan.json").write_text('{"schema": 9}')
    results = read_results([tmp_path / "r"])
    assert len(results.runs) == len(runs) - 1
    told = "\n".join(results.problems)
    assert f"{runs[0]}: not a configuration of ours (JSONDecodeError" in told
    assert f"{runs[1].parent}: no evaluation of this run yet; make one with `gvz evaluate {runs[1].parent}`" in told
    assert f"{runs[2].parent / 'episodes.jsonl'}, line " in told
    assert any("plan.json: schema 9, want 2; " in p and p.endswith("are not in this report") for p in results.problems)


def test_a_missing_path_is_an_error(tmp_path):
    with pytest.raises(ConfigError, match="no such file or directory"):
        read_results([tmp_path / "nowhere"])


def test_pauses_between_processes_are_no_training_time():
    metrics = pl.DataFrame(
        {
            "num_updates": [100, 200, 300],
            "time_s": [0.0, 10.0, 5000.0],  # stopped for more than an hour
            "learner/updates_per_s": [10.0, 10.0, 20.0],
        }
    )
    assert training_time_s(metrics) == 10 + 10 + 5


def test_records_may_be_compressed(small, tmp_path):
    source = small / TRAIN4 / "seed_1111"
    shutil.copy(source / "config.json", tmp_path)
    for name in ("metrics", "episodes", "evaluation"):
        (tmp_path / f"{name}.jsonl.gz").write_bytes(gzip.compress((source / f"{name}.jsonl").read_bytes()))
    results = read_results([tmp_path])
    (run,) = results.runs
    assert len(run.metrics) == 20
    assert run.training_episodes["normalized_score"].max() == 100.0
    assert json.loads((tmp_path / "config.json").read_text())["resolved"]["tasks"] == list(run.tasks)
    assert len(results.episodes) > 0


@pytest.fixture
def a_run(small, tmp_path):
    """A run directory of its own."""
    source = small / TRAIN4 / "seed_1111"
    return shutil.copytree(source, tmp_path / "run")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"total_updates": 20', '"total_updates": Infinity'),
        ('"tasks": ["', '"tasks": "", "x": ["'),
        ('"name": "', '"name": "\\ud800'),
        ('"config": {', '"config": ' + "[" * 100_000 + " {"),
    ],
)
def test_a_configuration_that_no_report_can_show_is_told_of(a_run, old, new):
    file = a_run / "config.json"
    text = json.dumps(json.loads(file.read_text()))
    assert old in text
    file.write_text(text.replace(old, new))
    results = read_results([a_run])
    assert results.runs == ()
    assert any(f"{file}: not a configuration of ours (" in problem for problem in results.problems)


def test_values_of_another_type_are_left_out_and_starts_told_of(a_run):
    row = {"schema": 1, "num_updates": 7, "learner/updates_per_s": "fast", "actors/env_steps": 2**63}
    (a_run / "metrics.jsonl").write_text(json.dumps(row) + "\n" + json.dumps({**row, "num_updates": [7]}) + "\n")
    starts = [{"schema": 1, "cores": 2}, {"schema": 1, "memory_bytes": 2**80}, {"schema": 1, "versions": "1"}]
    (a_run / "starts.jsonl").write_text("".join(json.dumps(start) + "\n" for start in starts))
    results = read_results([a_run])
    (run,) = results.runs
    assert run.metrics["num_updates"].to_list() == [7]
    assert run.metrics["learner/updates_per_s"].to_list() == [None]
    assert run.metrics["actors/env_steps"].to_list() == [None]
    assert run.starts == ({"schema": 1, "cores": 2},)
    told = "\n".join(results.problems)
    assert f"starts.jsonl, row 2: not the start of a run (memory_bytes is {2**80})" in told
    assert "starts.jsonl, row 3: not the start of a run (versions is '1')" in told


def test_a_curriculum_s_shares_are_a_figure(a_run, tmp_path):
    (tmp_path / "figures").mkdir()
    assert [s.id for s in run_sections(read_results([a_run]), tmp_path)] == ["runs", "configuration", "records"]
    file = a_run / "config.json"
    file.write_text(file.read_text().replace('"kind": "fixed"', '"kind": "level"'))
    results = read_results([a_run])
    assert [s.id for s in run_sections(results, tmp_path)] == ["runs", "configuration", "curriculum", "records"]
    assert list((tmp_path / "figures").glob("shares_*.png"))
