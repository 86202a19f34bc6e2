"""DECORATE text: which actor classes it declares. Imports the standard library only."""

import re

# What is begun is always ended, at the latest by the end of the text: else each unclosed beginning would be searched
# for its end again, in a time that grows with the square of their number. Likewise blank lines below.
_COMMENT_OR_STRING = re.compile(r'//[^\n]*|/\*.*?(?:\*/|\Z)|"(?:[^"\\\n]|\\.)*"?', re.DOTALL)
_ACTOR = re.compile(r"^[^\S\n]*actor\s+(?P<name>[A-Za-z0-9_~.]+)", re.IGNORECASE | re.MULTILINE)


def declared_actors(decorate: str) -> list[str]:
    """Names of the classes that DECORATE text declares with `ACTOR name ...`, in its order."""
    # Blanks instead of nothing: a comment between two words must go on keeping them apart.
    plain = _COMMENT_OR_STRING.sub(" ", decorate)
    return [match["name"] for match in _ACTOR.finditer(plain)]
