"""What the findings say of the segmentation networks is what their records give."""

import json

from gvz.tasks import named_tasks, scenarios
from tests.score_tables import PAGE, ROOT, WORDS, segmenter


def test_segmentation_networks_learned_from_training_tasks_alone():
    for name in scenarios():
        record = segmenter(name)
        assert record["tasks"] == [task.id for task in named_tasks(name, split="train8")], "no gate or test task"
        assert list(record["average_precision"]) == [task.id for task in named_tasks(name, split="gate")]


def test_the_findings_say_what_putting_frames_together_gave():
    record = json.loads((ROOT / "results" / "gates" / "segmenters" / "compositions.json").read_text())

    def row(title: str, task: str, measure: str) -> str:
        """Of every form of the networks: a number of the task, or a dash."""
        cells = []
        for form in ("before", "rendered_size", "by_depth", "144x252_pixels", "decorated", "three_frames_more"):
            found = record["networks"][form]["tasks"].get(task)
            values = {} if found is None else found | found["average_precision"]
            cells.append(f"{values[measure]:.2f}" if values else "-")
        return f"| {title} | {' | '.join(cells)} |"

    for title, task, measure in (
        ("shadows before red walls: average precision", "seek_and_kill/red+shadows", "enemy"),
        (
            "decorations before a stone wall: mean probability of an enemy",
            "defend_the_center/gore+stone_wall",
            "enemy_at_scenery",
        ),
        ("enemies among these: average precision", "defend_the_center/gore+stone_wall", "enemy"),
        (
            "fuzzy enemies before mossy bricks: average precision",
            "defend_the_center/fuzzy_enemies+mossy_bricks",
            "enemy",
        ),
        ("mixed enemies before blue walls: average precision", "seek_and_kill/blue+mixed_enemies", "enemy"),
        ("invulnerable enemies before red walls: average precision", "seek_and_kill/invulnerable+red", "enemy"),
    ):
        assert row(title, task, measure) in PAGE
        assert task in {pair.id for pair in named_tasks(task.partition("/")[0], split="pairs")}
    gate_tasks = [task.id for task in named_tasks("seek_and_kill", split="gate")]
    more = ("three_frames", "three_frames_more", "three_frames_longer", "tints_patches")
    for form in ("decorated", "few_own_things", "logarithm", "looks", "direct", *more):
        found = record["networks"][form]["tasks"]
        tasks = ["seek_and_kill/red+shadows", *gate_tasks]
        cells = " | ".join(f"{found[task]['average_precision']['enemy']:.2f}" for task in tasks)
        assert f" s | {cells} |" in PAGE
    found = record["networks"]["three_frames_more"]["tasks"]
    for name in ("defend_the_center", "seek_and_kill"):  # which have networks of this form
        used = segmenter(name)["average_precision"]
        assert used == {task: found[task]["average_precision"] for task in used}
    count = record["put_together"]["enemies_per_frame"]
    assert f"too few enemies**: {count['one_frame']:.1f} a frame before red walls" in PAGE
    assert f"have {count['real']:.1f}. Near walls hide far things. With things of three frames they hold" in PAGE
    assert f"they hold {count['three_frames']:.1f}." in PAGE
    numbers = record["put_together"]["seek_and_kill/red+shadows"]
    assert f"average precision of {numbers['put_together']:.2f}, and with {numbers['real']:.2f}" in WORDS
    trials = record["put_together"]["of_trials"]
    last, second = (trials[form].values() for form in ("direct", "few_own_things"))
    last, second = (" and ".join(f"{x:.2f}" for x in one) for one in (last, second))
    said = f"{last} for the fifth network, {second} for the second"
    assert said in WORDS


def test_the_findings_say_what_the_trials_of_health_gathering_found():
    trials = json.loads((ROOT / "results" / "gates" / "segmenters" / "health_gathering_trials.json").read_text())
    forms = {
        "one_frame": "things of one frame in each",
        "base": "three frames: things of three in each",
        "tint": "three frames, surfaces in shades of a drawn colour",
        "texture": "three frames, surfaces with a drawn texture",
        "both": "three frames, some surfaces of either kind",
        "varied": "three frames, and frames of varied maps",
        "base_1500": "three frames",
        "texture_1500": "three frames, surfaces with a drawn texture",
        "patches": "three frames, surfaces with patches",
        "tints_patches": "three frames, surfaces with tints and patches",
    }
    assert list(trials["networks"]) == list(forms)
    rows = [(forms[form], one) for form, one in trials["networks"].items()]
    rows.append(("used: three frames, surfaces with tints and patches", segmenter("health_gathering")))
    for title, network in rows:
        found = network["average_precision"]
        assert list(found) == [task.id for task in named_tasks("health_gathering", split="gate")]
        cells = [f"{scores['kit']:.2f}" for scores in found.values()]
        poison = found["health_gathering/poison+stimpacks"]["poison"]
        assert f"| {title} | {network['processor_s']:,.0f} s | {' | '.join(cells)} | {poison:.2f} |" in PAGE
