"""The section over all scenarios: one number for each agent that was evaluated in several of them."""

from gvz.evaluation.statistics import mean_over_scenarios
from gvz.reports.document import Block, Section, Table, words
from gvz.reports.results import Results
from gvz.reports.scenario_section import agents_of
from gvz.reports.scores import agent_scores, estimate, estimate_groups
from gvz.tasks import named_tasks, scenario_named, scenarios


def joint_sections(results: Results) -> list[Section]:
    """The section, if an agent has the test tasks of two scenarios or more."""
    episodes = results.episodes.drop_nulls("level")
    test = {name: [task.id for task in named_tasks(name, split="test")] for name in scenarios()}
    scores = {agent: agent_scores(episodes, agent) for agent in agents_of(episodes)}
    played = {
        agent: [name for name, tasks in test.items() if one.complete_seeds(tasks)] for agent, one in scores.items()
    }
    shown = [name for name in test if any(name in names for names in played.values())]
    agents = [agent for agent, names in played.items() if len(names) > 1]
    if not agents:
        return []
    rows = [
        (
            words(agent),
            *(estimate(scores[agent], test[name]) for name in shown),
            estimate_groups([(scores[agent], test[name]) for name in shown], mean_over_scenarios),
        )
        for agent in agents
    ]
    table = Table(
        id="joint",
        caption="Test tasks of each scenario, percent of the upper bound, and the mean over scenarios (P_norm).",
        columns=("agent", *(scenario_named(name).title for name in shown), "P_norm"),
        rows=tuple(rows),
        notes=("- : not evaluated on all test tasks of all these scenarios.",),
    )
    return [Section(id="joint", title="All scenarios", blocks=(Block(tables=(table,)),))]
