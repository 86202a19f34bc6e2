"""What the README says of committed results is what their records give."""

import gzip
import json
from pathlib import Path

import numpy as np

from gvz.evaluation.metrics import Estimate, bootstrap

ROOT = Path(__file__).parent.parent


def evaluation(name: str) -> tuple[Estimate, list[int]]:
    with gzip.open(ROOT / "results" / "rainbow_quick" / name, "rt") as file:
        rows = [json.loads(line) for line in file]
    return bootstrap([np.array([row["score"] for row in rows])]), sorted(row["seed"] for row in rows)


def test_the_quick_run_is_better_than_chance_on_the_same_episodes():
    trained, trained_seeds = evaluation("evaluation.jsonl.gz")
    chance, chance_seeds = evaluation("evaluation_random.jsonl.gz")
    assert len(trained_seeds) == 100
    assert trained_seeds == chance_seeds
    assert chance.high < trained.low
    readme = (ROOT / "README.md").read_text()
    assert f"| random | {chance} |" in readme
    assert f"| rainbow_quick, 20,000 updates | {trained} |" in readme
