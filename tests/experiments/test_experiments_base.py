"""Experiments as data: every one there is, the published numbers by their own averages, and what is refused."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from gvz.core.errors import ConfigError, TaskError
from gvz.experiments.base import Experiment, TrainingRun, experiment_named, experiments
from gvz.run.config_files import load_config, with_settings
from gvz.segmentation import segmenter_file
from gvz.tasks import attribute_tasks, named_tasks, parse_task, scenarios

THESIS_AVERAGES = {
    "training_difficulty": (79.99, 66.23, 42.91, 30.84, 24.81),
    "training_set_size": (32.34, 38.22, 37.33),
    "algorithm_comparison": (23.44, 41.84),
    "rainbow_evaluation": (82.24, 66.64, 52.08, 34.02, 23.87),
}
"""last rows of Tables 5.3 to 5.6"""

LEVEL_AVERAGES = {
    "training_difficulty": (50.42, 56.90, 33.72, 54.79),
    "rainbow_evaluation": (60.42, 51.91, 46.27, 48.47),
}
"""last columns of Tables 5.3 and 5.6"""

ALL = sorted(experiments())


def make_experiment(**changes) -> Experiment:
    return dataclasses.replace(experiments()["quick_comparison"], **changes)


def test_the_thesis_s_four_are_there():
    assert set(THESIS_AVERAGES) < set(ALL)


def test_varied_maps_are_a_training_of_every_scenario():
    trainings = {"trainings": ("varied", "varied-10"), "columns": "training", "configs": ("rainbow_quick",)}
    runs = make_experiment(**trainings, seeds=(1,), evaluate_on="gate").runs()
    assert {run.tasks for run in runs} == {("defend_the_center/varied",), ("defend_the_center/varied-10",)}
    with pytest.raises(TaskError, match="want 'varied-<number of maps>'"):
        make_experiment(trainings=("varied-0",)).runs()


def test_the_gap_is_between_the_maps_trained_on_and_those_of_procedural_test():
    gap = experiments()["procedural_gap"]
    run = gap.runs()[0]
    assert run.tasks == ("defend_the_center/procedural-train-10",)
    assert gap.evaluation_tasks(run) == ("defend_the_center/procedural-test", *run.tasks)
    assert gap.table_tasks(run) == ("defend_the_center/procedural-test",)
    with pytest.raises(ConfigError, match="evaluate_on 'procedural' wants columns 'config' or 'training'"):
        dataclasses.replace(gap, columns="level")


@pytest.mark.parametrize("name", ALL)
def test_every_run_has_an_id_of_its_own_tasks_of_its_scenario_and_checkpoints_up_to_its_end(name):
    runs = experiments()[name].runs()
    assert len({run.id for run in runs}) == len(runs)
    for run in runs:
        assert {parse_task(task).scenario.id for task in run.tasks} == {run.scenario}
        assert len(run.checkpoints) == run.num_checkpoints
        assert run.checkpoints[-1] == run.total_updates
        assert list(run.checkpoints) == sorted(set(run.checkpoints))
        env = with_settings(run.run_config, run.settings).env
        assert env.frames != "segmented" or segmenter_file(run.scenario, env), "its network comes with GViZDoom"


@pytest.mark.parametrize(("name", "averages"), THESIS_AVERAGES.items())
def test_published_numbers_average_to_the_thesis_s_last_row(name, averages):
    rows = experiments()[name].published["thesis"]
    assert set(rows) == set(scenarios())
    assert experiments()[name].scenarios == tuple(rows), "in the order of the thesis"
    assert np.mean(list(rows.values()), axis=0) == pytest.approx(averages, abs=0.0051)


@pytest.mark.parametrize(("name", "averages"), LEVEL_AVERAGES.items())
def test_published_levels_average_to_the_thesis_s_last_column(name, averages):
    rows = list(experiments()[name].published["thesis"].values())
    assert np.mean(rows, axis=1) == pytest.approx(averages, abs=0.0061)  # 51.904 is printed as 51.91


def test_levdoom_s_scores_stand_as_percent_of_its_bounds():
    rows = experiments()["algorithm_comparison"].published["LevDoom"]
    assert rows["defend_the_center"] == (30.75, 35.02)  # 645.7 and 735.4 of 2100 frames
    assert rows["seek_and_kill"] == (56.0, 64.5)  # 11.2 and 12.9 of 20 kills


@pytest.mark.parametrize(
    ("name", "runs", "updates", "tasks"),
    [
        ("training_difficulty", 76 * 3, 500_000, 1),
        ("training_set_size", 4 * 3 * 3, 200_000, 7),
        ("algorithm_comparison", 4 * 2 * 3, 200_000, 7),
        ("rainbow_evaluation", 4 * 3, 200_000, 18),
        ("quick_comparison", 2 * 3, 20_000, 18),
    ],
)
def test_grids_are_the_thesis_s(name, runs, updates, tasks):
    experiment = experiments()[name]
    found = experiment.runs()
    assert len(found) == runs
    assert {run.total_updates for run in found} == {updates}
    assert {run.seed for run in found} == {1111, 2222, 3333}
    assert len(experiment.evaluation_tasks(found[0])) == tasks


def test_training_difficulty_evaluates_each_run_on_its_own_task():
    experiment = experiments()["training_difficulty"]
    for run in experiment.runs():
        assert experiment.evaluation_tasks(run) == run.tasks
    names = {run.training for run in experiment.runs() if run.scenario == "defend_the_center"}
    assert names == {task.name for task in named_tasks("defend_the_center")}


def test_the_effects_of_attributes_are_measured_on_each_alone_and_on_pairs():
    experiment = experiments()["attribute_effects"]
    run = experiment.runs()[0]
    assert experiment.evaluation_tasks(run) == tuple(task.id for task in attribute_tasks(run.scenario))


def test_the_table_of_a_comparison_is_over_the_test_tasks_and_that_of_levels_over_all():
    quick, levels = experiments()["quick_comparison"], experiments()["rainbow_evaluation"]
    test = tuple(task.id for task in named_tasks("defend_the_center", split="test"))
    assert set(quick.table_tasks(quick.runs()[0])) == set(test)
    assert len(levels.table_tasks(levels.runs()[0])) == 18


def test_a_run_is_named_by_config_scenario_training_and_seed():
    run = TrainingRun(
        config="rainbow_4task",
        scenario="seek_and_kill",
        training="train4",
        tasks=("seek_and_kill/default",),
        seed=2222,
        total_updates=200,
        num_checkpoints=3,
    )
    assert run.id == "rainbow_4task/seek_and_kill/train4/seed_2222"
    assert run.checkpoints == (66, 132, 200)


def test_every_config_is_trained_with_every_variant_under_a_name_of_its_own():
    variants = {"plain": {}, "large": {"learner.batch_size": 64, "agent.encoder": "small"}}
    runs = make_experiment(variants=variants, seeds=(1,)).runs()
    ids = [run.id.partition("/")[0] for run in runs]
    assert ids == ["dqn_quick+plain", "dqn_quick+large", "rainbow_quick+plain", "rainbow_quick+large"]
    assert make_experiment(variants=variants).column_names == tuple(ids)
    plain, large = runs[2].run_config, runs[3].run_config
    assert plain == load_config("rainbow_quick")
    assert (large.learner.batch_size, large.agent.encoder) == (64, "small")
    assert dataclasses.replace(large, learner=plain.learner, agent=plain.agent) == plain


def test_a_gate_is_evaluated_on_the_gate_tasks_and_on_those_of_training_and_its_table_is_over_the_first():
    gate = experiments()["gate_reuse"]
    run = gate.runs()[-1]
    gates = tuple(task.id for task in named_tasks(run.scenario, split="gate"))
    assert gate.evaluation_tasks(run) == (*gates, *run.tasks)
    assert gate.table_tasks(run) == gates
    assert len(gate.runs()) == 2 * 3 * 2
    test = {task.id for task in named_tasks(split="test")}
    assert not test & {task for run in gate.runs() for task in gate.evaluation_tasks(run)}


def test_settings_change_their_fields_alone_and_another_agent_comes_first():
    config = load_config("rainbow_quick")
    found = with_settings(config, {"agent.epsilon_end": 0.5, "agent.name": "dqn", "seed": 7})
    assert (found.agent.name, found.seed) == ("dqn", 7)
    assert getattr(found.agent, "epsilon_end") == 0.5  # noqa: B009  # a field of some agents
    assert found.agent.conv_channels == config.agent.conv_channels
    for name in ("learner.batchsize", "batch_size", "learner", "seed.x", "learner.batch_size.x"):
        with pytest.raises(ConfigError, match=f"settings: got {name}, want a field"):
            with_settings(config, {name: 1})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": ()}, r"experiment quick_comparison: seeds: got \(\), want at least one, each once"),
        ({"seeds": (1, 1)}, "want at least one, each once"),
        ({"configs": "dqn_quick"}, r"configs: got 'dqn_quick', want a tuple, such as \('dqn_quick',\)"),
        ({"players": "random"}, r"players: got 'random', want a tuple, such as \('random',\)"),
        ({"players": ["random"]}, r"players: got \['random'\], want a tuple$"),
        ({"total_updates": 2e5}, "total_updates: got 200000.0, want int"),
        ({"seeds": (1.5,)}, "seeds: got 1.5, want int"),
        ({"variants": ("a",)}, r"variants: got \('a',\), want a mapping"),
        ({"tasks_per_level": 0}, "tasks_per_level: got 0, want at least 1"),
        ({"published": {"thesis": {"seek_an_kill": (1.0, 2.0)}}}, "unknown scenario 'seek_an_kill'"),
        (
            {"evaluate_on": "everything"},
            "evaluate_on: got 'everything', want one of own, test, all, gate, procedural, at",
        ),
        ({"columns": "configs"}, "columns: got 'configs', want one of level, training, config"),
        ({"episodes": 0}, "episodes: got 0, want at least 1"),
        ({"num_checkpoints": 4, "total_updates": 3}, "num_checkpoints 4, total_updates 3, want each at most the next"),
        (
            {"trainings": ("test",)},
            "want train1, train4, train8, pairs, compositions, train8_varied, varied, varied-<number",
        ),
        ({"variants": {"a b": {}}}, r"variants: got 'a b', want letters, digits and \. _ - \(it names"),
        ({"variants": {"a": {"seed": 1, "learner.batch_size": 1}}}, "variant a sets seed, which the experiment sets"),
        ({"max_processor_s": 0.0, "num_checkpoints": 1}, "max_processor_s 0 and num_checkpoints 1, want more than 0"),
        ({"max_processor_s": 9.0}, "max_processor_s 9 and num_checkpoints 2, want more than 0 and exactly 1"),
        ({"evaluate_on": "gate", "columns": "level"}, "'gate' wants columns 'config' or 'training'"),
        ({"evaluate_on": "own"}, "evaluate_on 'own' wants trainings"),
        (
            {"trainings": ("train4", "train8")},
            "trainings: got train4, train8, want one: columns 'config' would mix them",
        ),
        ({"trainings": ("each",)}, "trainings: got each, want one: columns 'config' would mix them"),
        ({"columns": "training"}, "agents: got dqn_quick, rainbow_quick, want one: columns 'training' would mix them"),
        ({"published": {"thesis": {"seek_and_kill": (1.0,)}}}, r"seek_and_kill: got 1 numbers, want 2, one for each"),
        ({"scenarios": ("defend_the_centre",)}, "unknown scenario 'defend_the_centre'"),
        ({"players": ("ghost",)}, "players: got ghost, want some of random, idle, sweep, scripted"),
    ],
)
def test_an_experiment_that_cannot_be_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make_experiment(**changes)


def test_an_unknown_name_is_answered_with_the_nearest():
    with pytest.raises(ConfigError, match=r"unknown experiment 'training_size'.*training_set_size"):
        experiment_named("training_size")


def test_the_page_lists_every_experiment_with_its_size():
    page = (Path(__file__).parents[2] / "docs" / "EXPERIMENTS.md").read_text()
    for experiment in experiments().values():
        lines = [line for line in page.splitlines() if line.startswith(f"| `{experiment.name}` |")]
        assert len(lines) == 1, f"want one row of {experiment.name} in a table of docs/EXPERIMENTS.md"
        seconds = "-" if experiment.max_processor_s is None else f"{experiment.max_processor_s:,.0f}"
        assert lines[0].endswith(f" | {seconds} | {len(experiment.runs())} | {experiment.total_updates:,} |")
