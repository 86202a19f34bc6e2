"""The findings' table and picture of players by level are what the records give."""

from PIL import Image

from tests.level_scores import PICTURE, PLAYERS, level_row
from tests.score_tables import PAGE


def test_the_findings_say_and_show_what_players_have_by_level():
    rows = [level_row(player) for player in PLAYERS]
    assert "\n".join(rows) in PAGE
    with Image.open(PICTURE) as picture:
        assert picture.info["Description"].splitlines() == rows, "draw it again: python -m tests.level_scores"
