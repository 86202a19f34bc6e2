"""What the findings say of four training tasks is what the records of these agents and their networks give."""

from collections.abc import Callable

import pytest

from gvz.reports.scores import Scores, agent_scores
from gvz.tasks import scenario_named, scenarios
from tests.score_tables import (
    WORDS,
    gain,
    in_words,
    last_updates,
    means,
    of_first_seed,
    results_of,
    score_cells,
    scores_of,
    segmenter,
    task_mean,
    task_sets,
)

AGENTS = {
    "4 tasks": ("general_train4", "rainbow_segmented+train4_network"),
    "8 tasks": ("general_short", "rainbow_segmented"),
}
SAID = (
    ("defend_the_center", "fuzzy_enemies+gore+stone_wall"),
    ("dodge_projectiles", "arachnotron+city"),
    ("health_gathering", "poison+resized_kits+shaded_kits"),
    ("seek_and_kill", "blue+shadows"),
)


@pytest.fixture(scope="module")
def scores() -> dict[tuple[str, str], Scores]:
    return {
        (name, called): scores_of(folder, agent, name)
        for name in scenarios()
        for called, (folder, agent) in AGENTS.items()
    }


def test_the_findings_say_what_agents_of_four_training_tasks_have(scores: dict[tuple[str, str], Scores]):
    trained = [means({name: scores[name, called] for name in scenarios()}, "train4")[0].split()[0] for called in AGENTS]
    assert "agents have {} on the four, those of eight tasks {}.".format(*trained) in WORDS

    def gains(column: int) -> list[str]:
        """Of eight tasks, by scenario."""
        return [gain(scores[one, "8 tasks"], scores[one, "4 tasks"], task_sets(one)[column]) for one in scenarios()]

    def rounded(column: int) -> str:
        return "{:.0f}, {:.0f}, {:.0f} and {:.0f}".format(*(float(one.split()[0]) for one in gains(column)))

    assert f"not four, beside segmented frames | {' | '.join(gains(1))} | yes |" in WORDS
    assert f"agents of four tasks have {rounded(2)} points less than those of eight**" in WORDS
    assert f"on the gate tasks {rounded(1)} (900" in WORDS


def test_the_findings_say_what_networks_of_four_training_tasks_find():
    for name in scenarios():
        four, eight = (segmenter(network)["average_precision"] for network in (f"train4/{name}", name))
        assert list(four) == list(eight)
        if name == "seek_and_kill":
            pairs = [
                f"{of[f'{name}/{task}']['enemy']:.2f}"
                for task in ("blue+invulnerable", "obstacles+shadows")
                for of in (four, eight)
            ]
            said = "invulnerable enemies are found with {}, not {}, and shadows among obstacles with {}, not {}."
            assert said.format(*pairs) in WORDS
        if name == "defend_the_center":
            fuzzy = [f"{of['defend_the_center/fast_enemies+fuzzy_enemies']['enemy']:.2f}" for of in (four, eight)]
            assert "fuzzy enemies are found with {}, not {}.".format(*fuzzy) in WORDS
        for task, found in four.items():
            for kind, value in found.items():
                assert f"| `{task}` | {kind} | {value:.2f} | {eight[task][kind]:.2f} |" in WORDS


def test_the_findings_say_what_six_times_the_time_gave_on_four_training_tasks(scores: dict[tuple[str, str], Scores]):
    folders = {"4 tasks": "general_train4_long", "8 tasks": "general"}
    longer = {
        (name, called): scores_of(folder, AGENTS[called][1], name)
        for name in scenarios()
        for called, folder in folders.items()
    }
    for called in AGENTS:
        for seconds, of_all in (("900 s", scores), ("5,400 s", longer)):
            cells = " | ".join(means({name: of_all[name, called] for name in scenarios()}, "train4"))
            assert f"| mean | {called} | {seconds} | {cells} |" in WORDS
    for (name, called), of_agent in longer.items():
        title, short = scenario_named(name).title, scores[name, called]
        assert len(of_agent.runs) == 3
        assert f"| {title} | {called} | 900 s | {score_cells(short, name, 'train4')} |" in WORDS
        assert f"| {title} | {called} | 5,400 s | {score_cells(of_agent, name, 'train4')} |" in WORDS

    def differences(pair: Callable[[str], tuple[Scores, Scores]], column: int) -> str:
        """By scenario, on a set of `task_sets`."""
        return in_words([gain(*pair(name), task_sets(name, "train4")[column]) for name in scenarios()])

    def more_time(name: str) -> tuple[Scores, Scores]:
        return longer[name, "4 tasks"], scores[name, "4 tasks"]

    def fewer_tasks(name: str) -> tuple[Scores, Scores]:
        return longer[name, "4 tasks"], longer[name, "8 tasks"]

    assert f"they gain {differences(more_time, 0)} points." in WORDS
    assert f"gate tasks gain {differences(more_time, 1)} points" in WORDS
    assert f"test tasks {differences(more_time, 2)}" in WORDS
    assert f"with the same time: {differences(fewer_tasks, 2)}" in WORDS

    for name, task in SAID:
        four_short, four, eight = (
            task_mean(of[name, called], f"{name}/{task}")
            for of, called in ((scores, "4 tasks"), (longer, "4 tasks"), (longer, "8 tasks"))
        )
        said = f"`{task}` has {four:.0f} (after 900 seconds {four_short:.0f}, with eight tasks {eight:.0f})"
        assert said in WORDS
    steps = last_updates("general_train4_long/runs/**")
    without_avx512 = ("health_gathering/*/seed_1111", "[ds]*/*/seed_2222", "*/*/seed_3333")
    slow = sorted(one for run in without_avx512 for one in last_updates(f"general_train4_long/runs/*/{run}"))
    assert slow == steps[: len(slow)]
    assert f"3333; {slow[0]:,} to {steps[-1]:,} gradient steps, 50 episodes a task" in WORDS
    assert f"had no AVX-512; they have {slow[0]:,} to {slow[-1]:,} gradient steps." in WORDS


def test_the_findings_say_what_two_hours_of_two_cores_gave_on_four_training_tasks():
    name, agent = "defend_the_center", AGENTS["4 tasks"][1]
    longest, longer = (
        agent_scores(of_first_seed(results_of(f"general_train4_{folder}").episodes.filter(scenario=name)), agent)
        for folder in ("two_hours", "long")
    )
    for seconds, folder, of_agent in (("5,400 s", "long", longer), ("14,400 s", "two_hours", longest)):
        (steps,) = last_updates(f"general_train4_{folder}/runs/*/{name}/*/seed_1111")
        assert f"| {seconds} | {steps:,} | {score_cells(of_agent, name, 'train4')} |" in WORDS
    trained, gate, test, hardest = (gain(longest, longer, tasks) for tasks in task_sets(name, "train4"))
    assert f"No difference is shown: on the training tasks {trained}, on the gate tasks {gate}, on the" in WORDS
    assert f"on the test tasks {test}, on level 4 {hardest} points." in WORDS


def test_the_findings_say_how_long_agents_of_four_training_tasks_learned():
    steps = last_updates("general_train4/runs/**")
    assert f"{steps[0]:,} to {steps[-1]:,} gradient steps on four tasks" in WORDS
