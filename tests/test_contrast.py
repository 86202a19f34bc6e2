"""Contrast: hand-worked numbers, and a record that the choice of a texture rests on."""

import json

import numpy as np
import pytest

from benchmarks.contrast import FILE, contrast, measure_contrast, separation
from gvz.scenarios.base import Task
from gvz.tasks import scenario_named
from tests.score_tables import words_of

SEEK_AND_KILL = scenario_named("seek_and_kill")


def test_a_contrast_is_counted_in_deviations_of_the_surroundings():
    around = np.repeat([[90.0] * 3, [110.0] * 3], 8, axis=0)  # luminance 100, deviation 10
    assert contrast(np.full((5, 3), 130.0), around) == pytest.approx(3.0)


def test_a_separation_finds_the_colour_that_tells_a_thing():
    rng = np.random.default_rng(0)
    around = rng.normal(100, [20, 20, 2], size=(20_000, 3))
    blue = around + np.array([0, 0, 8])  # a gap of 4 deviations in blue, next to none in luminance
    assert separation(blue, around) == pytest.approx(8 / np.sqrt(4 + 1), rel=0.02)
    assert contrast(blue, around) < 0.1


@pytest.mark.engine
def test_shadows_before_a_texture_hide_enemies():
    default, hidden = (measure_contrast(Task(SEEK_AND_KILL, names), 3) for names in ((), ("blue", "shadows")))
    assert min(default["num_enemies"], hidden["num_enemies"]) >= 20
    assert default["separation"] > 2 * hidden["separation"]


def test_complete_has_the_texture_before_which_enemies_show_most_and_the_page_says_by_how_much():
    rows = json.loads(FILE.read_text())["rows"]
    default, blue, red = (rows[name] for name in ("default", "complete with blue", "complete with red"))
    assert red["contrast"] > blue["contrast"]
    assert red["separation"] > blue["separation"]
    assert "red" in SEEK_AND_KILL.complete
    page = words_of("docs/benchmark/differences.md")
    for told in (
        f"differ from their surroundings by {red['contrast']:.2f} standard deviations of luminance",
        f"in front of `blue`, by {blue['contrast']:.2f}",
        f"they are {red['separation']:.2f} and {blue['separation']:.2f} apart",
        f"in the default task {default['separation']:.2f}",
    ):
        assert told in page, told
