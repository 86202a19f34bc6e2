"""DECORATE text: which actor classes it declares, which sprites it shows."""

import re

# The end of the text also ends a comment or string. Otherwise each unclosed comment would be searched to the end again,
# in a time that grows with the square of their number. For the same reason the patterns below start with the blanks of
# one line only.
_COMMENT_OR_STRING = re.compile(r'//[^\n]*|/\*.*?(?:\*/|\Z)|"(?:[^"\\\n]|\\.)*"?', re.DOTALL)
_ACTOR = re.compile(r"^[^\S\n]*actor\s+(?P<name>[A-Za-z0-9_~.]+)", re.IGNORECASE | re.MULTILINE)
_NAME = r"[A-Za-z0-9_~.]+"
_NUMBERED_ACTOR = re.compile(
    rf"^[^\S\n]*actor\s+{_NAME}(?:\s*:\s*{_NAME})?(?:\s+replaces\s+{_NAME})?\s+(?P<number>[0-9]+)",
    re.IGNORECASE | re.MULTILINE,
)
_STATE = re.compile(
    r"(?:^|[:{])[^\S\n]*(?P<sprite>[A-Z0-9_]{4})[^\S\n]+(?P<frames>[A-Z\[\]\\]+)[^\S\n]+(?:-?[0-9]|random)",
    re.IGNORECASE | re.MULTILINE,
)
_NO_SPRITE = "TNT1"
"""the sprite of invisible things"""


def declared_actors(decorate: str) -> list[str]:
    """Names of the classes that DECORATE text declares with `ACTOR name ...`, in the order of the text."""
    return [match["name"] for match in _ACTOR.finditer(_plain(decorate))]


def declared_numbers(decorate: str) -> frozenset[int]:
    """The editor numbers of the classes that DECORATE text declares with `ACTOR name ... number`."""
    return frozenset(int(match["number"]) for match in _NUMBERED_ACTOR.finditer(_plain(decorate)))


def used_sprites(decorate: str) -> frozenset[str]:
    """Sprites with their frames, such as `BON1A`, in the states of DECORATE text, without quoted ones."""
    return frozenset(
        f"{match['sprite']}{frame}".upper()
        for match in _STATE.finditer(_plain(decorate))
        for frame in match["frames"]
        if match["sprite"].upper() != _NO_SPRITE
    )


def _plain(decorate: str) -> str:
    """The text without comments and strings."""
    # Blanks, not nothing: a comment between two words must still separate them.
    return _COMMENT_OR_STRING.sub(" ", decorate)
