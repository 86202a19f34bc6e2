"""The sections on the runs: what each agent's runs were configured to be."""

import json

from gvz.experiments.inventory import run_directory
from gvz.experiments.plan import Plan
from gvz.reports.results import read_results
from gvz.reports.run_section import run_sections

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
