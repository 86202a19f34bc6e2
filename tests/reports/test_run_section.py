"""The sections on the runs: what each agent's runs were configured to be."""

import json

from gvz.experiments.base import experiment_named
from gvz.experiments.inventory import run_directory
from gvz.experiments.plan import Plan
from gvz.reports.results import read_results
from gvz.reports.run_section import run_sections
from gvz.reports.runs import read_run, training_time_s
from tests.reports.conftest import write_training

SCENARIOS = ("defend_the_center", "health_gathering", "seek_and_kill")


def test_a_configuration_has_the_values_of_all_runs_of_an_agent(tmp_path, experiments_writer):
    """Two agents of one name, which a setting tells apart; one of them has another discount in one scenario."""
    plan = Plan.of("general_on_policy", scale=0.0001, scenarios=SCENARIOS)
    experiments_writer(tmp_path / "r", plan, lambda _: 50.0)
    run = next(run for run in plan.runs() if run.scenario == "health_gathering")
    saved = json.loads((run_directory(tmp_path / "r", run) / "config.json").read_text())
    saved["config"]["seed"], saved["config"]["agent"]["hidden_units"] = 2222, 7
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "config.json").write_text(json.dumps(saved))
    results = read_results([tmp_path / "r", tmp_path / "other"])
    sections = {section.id: section for section in run_sections(results, tmp_path)}
    (table,) = sections["configuration"].blocks[0].tables
    assert table.columns == ("field", "ppo_segmented", "ppo_segmented (agent.hidden_units 7)")
    rows = {row[0].text: [cell.text for cell in row[1:]] for row in table.rows}
    assert rows["agent.discount"] == ["0.95; 0.98 (health_gathering)", "0.98"]
    assert rows["agent.hidden_units"] == ["128", "7"]


def test_training_takes_all_gradient_steps_at_their_rates_and_cut_episodes_are_none_of_it(tmp_path):
    planned = experiment_named("quick_comparison").runs()[0]
    directory = write_training(tmp_path, planned)
    with (directory / "episodes.jsonl").open("a") as file:
        file.write('{"schema": 1, "num_updates": 1, "task": "a", "score": 1.0, "normalized_score": 1.0, "cut": true}\n')
    run, problems = read_run(directory / "config.json", tmp_path)
    assert run is not None
    assert problems == []
    assert set(run.training_episodes["task"]) == set(planned.tasks)
    assert training_time_s(run.metrics) == planned.total_updates / 50.0
