"""What the findings say of the supervised probe is what its records give."""

from itertools import product
from typing import Any

import numpy as np
import pytest

from gvz.tasks import scenario_named
from tests.score_tables import ROOT, WORDS, in_words, rows_of

ENCODERS, AUGMENTATIONS = ("nature", "height_pool", "layer_norm"), ("none", "random_conv,contrast,gamma,shift")
SCENARIOS = {"defend_the_center": ("enemy",), "dodge_projectiles": ("enemy", "projectile")}
Key = tuple[str, str, str]


@pytest.fixture(scope="module")
def networks() -> dict[Key, list[dict[str, Any]]]:
    """The last row of each network."""
    last = {
        (row["scenario"], row["encoder"], row["augment"], row["seed"]): row
        for row in rows_of(ROOT / "results" / "gates" / "probe.jsonl.gz")
    }
    found = {
        (*key, augment): [last[*key, augment, seed] for seed in (0, 1)]
        for *key, augment in product(SCENARIOS, ENCODERS, AUGMENTATIONS)
    }
    assert len(last) == 2 * len(found)
    return found


def cell(rows: list[dict[str, Any]], frames: str, field: str) -> str:
    """Mean and range over two networks, percent."""
    values = [100 * row[frames][field] for row in rows]
    return f"{np.mean(values):.1f} [{min(values):.1f}, {max(values):.1f}]"


def test_the_findings_have_the_table_of_the_probe(networks: dict[Key, list[dict[str, Any]]]):
    for (scenario, encoder, augment), rows in networks.items():
        fields = ("action_accuracy", *(f"{thing}_balanced_accuracy" for thing in SCENARIOS[scenario]))
        cells = [cell(rows, frames, field) for field in fields for frames in ("held_out", "gate")]
        cells += ["-"] * (6 - len(cells))
        augmented = "no" if augment == "none" else "yes"
        assert f"| {scenario_named(scenario).title} | `{encoder}` | {augmented} | {' | '.join(cells)} |" in WORDS


def test_the_findings_say_what_augmentation_and_pooling_give_in_the_probe(networks: dict[Key, list[dict[str, Any]]]):
    def mean(scenario: str, field: str, encoders: tuple[str, ...], augmentations: tuple[str, ...]) -> float:
        rows = [row for key in product([scenario], encoders, augmentations) for row in networks[key]]
        return 100 * float(np.mean([row["gate"][field] for row in rows]))

    def gains(field: str, changed: tuple[Any, Any], plain: tuple[Any, Any]) -> str:
        """By scenario, of networks with these encoders and augmentations."""
        found = (mean(scenario, field, *changed) - mean(scenario, field, *plain) for scenario in SCENARIOS)
        return in_words([f"{gain:.1f}" for gain in found])

    augmented = (ENCODERS, AUGMENTATIONS[1:]), (ENCODERS, AUGMENTATIONS[:1])
    pooled = (ENCODERS[1:2], AUGMENTATIONS), (ENCODERS[:1], AUGMENTATIONS)
    for what, (changed, plain) in {"Augmented networks": augmented, "Networks that pool": pooled}.items():
        action, enemy = (gains(field, changed, plain) for field in ("action_accuracy", "enemy_balanced_accuracy"))
        assert f"{what} gain {action} points on the action, and {enemy} on enemies" in WORDS
    steps = [row["updates"] for rows in networks.values() for row in rows]
    assert f"{min(steps):,} to {max(steps):,} gradient steps" in WORDS
