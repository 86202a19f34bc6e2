"""DECORATE text: which actor classes it declares. Imports the standard library only."""

import re

_COMMENT_OR_STRING = re.compile(r'//[^\n]*|/\*.*?\*/|"(?:[^"\\\n]|\\.)*"', re.DOTALL)
_ACTOR = re.compile(r"^\s*actor\s+(?P<name>[A-Za-z0-9_~.]+)", re.IGNORECASE | re.MULTILINE)


def declared_actors(decorate: str) -> list[str]:
    """Names of the classes that DECORATE text declares with `ACTOR name ...`, in its order."""
    # Blanks instead of nothing: a comment between two words must go on keeping them apart.
    plain = _COMMENT_OR_STRING.sub(" ", decorate)
    return [match["name"] for match in _ACTOR.finditer(plain)]
