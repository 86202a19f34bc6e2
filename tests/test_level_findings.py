"""The findings' tables and picture of players by level are what the records give."""

from PIL import Image

from gvz.tasks import LEVELS, named_tasks
from tests.level_scores import PICTURE, PLAYERS, level_row, parts_row
from tests.score_tables import PAGE, WORDS, words_of


def test_the_findings_say_and_show_what_players_have_by_level():
    rows = [level_row(player) for player in PLAYERS]
    assert "\n".join(rows) in PAGE
    with Image.open(PICTURE) as picture:
        assert picture.info["Description"].splitlines() == rows, "draw it again: python -m tests.level_scores"


def test_the_findings_say_what_players_have_on_parts_of_the_levels():
    rows = [parts_row(player) for player in PLAYERS]
    assert "\n".join(rows) in PAGE
    own = [row.split(" | ")[-1].split()[0] for row in (rows[1], rows[-1])]
    assert "with own kills alone, the two means are {}% and {}%.".format(*own) in words_of("README.md")


def test_the_findings_say_which_levels_have_tasks_of_training_and_of_gates():
    levels = [set(named_tasks(level=level)) for level in LEVELS]
    eight, four, gate, test = (set(named_tasks(split=split)) for split in ("train8", "train4", "gate", "test"))
    easy, two = levels[0] | levels[1], levels[2]
    assert not (eight | gate) & (levels[3] | levels[4])
    assert levels[3] | levels[4] <= test
    assert two == (two & gate) | (two & test)
    assert (
        f"{len(easy & eight)} of the {len(easy)} tasks of level 0 and 1 are among the eight training tasks of their "
        f"scenario, {len(easy & four)} among the four. Of the {len(two)} tasks of level 2, {len(gate)} are gate tasks"
    ) in WORDS
