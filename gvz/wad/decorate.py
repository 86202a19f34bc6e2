"""DECORATE text: which actor classes it declares, which sprites it shows."""

import re

# What is begun is always ended, at the latest by the end of the text: else each unclosed beginning would be searched
# for its end again, in a time that grows with the square of their number. Likewise blank lines below.
_COMMENT_OR_STRING = re.compile(r'//[^\n]*|/\*.*?(?:\*/|\Z)|"(?:[^"\\\n]|\\.)*"?', re.DOTALL)
_ACTOR = re.compile(r"^[^\S\n]*actor\s+(?P<name>[A-Za-z0-9_~.]+)", re.IGNORECASE | re.MULTILINE)
_NAME = r"[A-Za-z0-9_~.]+"
_NUMBERED_ACTOR = re.compile(
    rf"^[^\S\n]*actor\s+{_NAME}(?:\s*:\s*{_NAME})?(?:\s+replaces\s+{_NAME})?\s+(?P<number>[0-9]+)",
    re.IGNORECASE | re.MULTILINE,
)
_STATE = re.compile(
    r"^[^\S\n]*(?P<sprite>[A-Z0-9_]{4})[^\S\n]+(?P<frames>[A-Z\[\]\\]+)[^\S\n]+(?:-?[0-9]|random)",
    re.IGNORECASE | re.MULTILINE,
)
_NO_SPRITE = "TNT1"
"""the sprite of what is not to be seen"""


def declared_actors(decorate: str) -> list[str]:
    """Names of the classes that DECORATE text declares with `ACTOR name ...`, in its order."""
    return [match["name"] for match in _ACTOR.finditer(_plain(decorate))]


def declared_numbers(decorate: str) -> frozenset[int]:
    """The editor numbers of the classes that DECORATE text declares with `ACTOR name ... number`."""
    return frozenset(int(match["number"]) for match in _NUMBERED_ACTOR.finditer(_plain(decorate)))


def used_sprites(decorate: str) -> frozenset[str]:
    """Sprites with their frames, such as `BON1A`, that the states in DECORATE text show; quoted ones are left out."""
    return frozenset(
        f"{match['sprite']}{frame}".upper()
        for match in _STATE.finditer(_plain(decorate))
        for frame in match["frames"]
        if match["sprite"].upper() != _NO_SPRITE
    )


def _plain(decorate: str) -> str:
    """The text without comments and strings."""
    # Blanks instead of nothing: a comment between two words must go on keeping them apart.
    return _COMMENT_OR_STRING.sub(" ", decorate)
