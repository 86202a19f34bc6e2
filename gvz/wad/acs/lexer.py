"""Splits ACS source text into tokens, each with its line and column."""

import re
from dataclasses import dataclass
from typing import Literal

from gvz.core.errors import AcsError

TokenKind = Literal["name", "number", "string", "symbol", "end"]

MAX_NUMBER_LENGTH = 16
"""maximum characters of a number literal; a longer one is not a 32-bit value"""

_PATTERN = re.compile(
    r"""(?P<blank>[\x00-\x20]+|//[^\n]*|/\*.*?\*/)
    |(?P<name>[A-Za-z_][A-Za-z0-9_]*)
    |(?P<number>0[xX][0-9A-Fa-f]+|[0-9]+(?:\.[0-9]*)?)
    |(?P<string>"(?:[^"\\\n]|\\[^\n])*")
    |(?P<symbol>\+\+|--|&&|\|\||<<|>>|[-+*/%=!<>]=|[-+*/%=!<>&|^~(){}\[\],;:\#])
    """,
    re.VERBOSE | re.DOTALL,
)


@dataclass(frozen=True, slots=True)
class Position:
    """1-based position in the source text."""

    line: int
    column: int


@dataclass(frozen=True, slots=True)
class Token:
    """One word of the source. `text` is lower case for names (ACS ignores case) and unquoted for strings."""

    kind: TokenKind
    text: str
    at: Position
    value: int = 0
    """of a number: the 32-bit value, fixed point already multiplied by 65536"""

    def __str__(self) -> str:
        return "the end of the source" if self.kind == "end" else f"{self.kind} {self.text!r}"


def error(at: Position, message: str) -> AcsError:
    """An error at the position `at`."""
    return AcsError(message, line=at.line, column=at.column)


def tokenize(source: str) -> list[Token]:
    """Splits ACS source into tokens; the last one has kind `end`.

    Refuses a character ACS does not know, an unterminated string or comment, a number beyond 32 bits, and a string that
    the engine's one-byte character set cannot hold.
    """
    tokens: list[Token] = []
    offset, line, line_start = 0, 1, 0
    while offset < len(source):
        at = Position(line, offset - line_start + 1)
        match = _PATTERN.match(source, offset)
        if match is None:
            raise _cannot_read(source[offset : offset + 2], at)
        text = match.group()
        if text == "/" and source.startswith("/*", offset):
            raise error(at, "unterminated comment: got the end of the source, want '*/'")
        match match.lastgroup:
            case "name":
                tokens.append(Token("name", text.lower(), at))
            case "number":
                tokens.append(Token("number", text, at, _number(text, at)))
            case "string":
                tokens.append(Token("string", _string(text[1:-1], at), at))
            case "symbol":
                tokens.append(Token("symbol", text, at))
            case _:  # space, a comment
                pass
        offset = match.end()
        if "\n" in text:
            line += text.count("\n")
            line_start = match.start() + text.rindex("\n") + 1
    tokens.append(Token("end", "", Position(line, offset - line_start + 1)))
    return tokens


def _cannot_read(text: str, at: Position) -> AcsError:
    if text.startswith('"'):
        return error(at, "unterminated string: got the end of the line, want a closing '\"'")
    return error(at, f"got the character {text[0]!r}, want a name, number, string or operator")


def _number(text: str, at: Position) -> int:
    if len(text) > MAX_NUMBER_LENGTH:
        raise error(at, f"got a number of {len(text)} characters, want at most {MAX_NUMBER_LENGTH}")
    if text[:2].lower() == "0x":
        value, highest = int(text, 16), 0xFFFFFFFF
    elif "." in text:
        # ACC truncates the fraction; integer arithmetic gives the same bits without rounding.
        whole, fraction = text.split(".")
        value = (int(whole) << 16) + ((int(fraction or "0") << 16) // 10 ** len(fraction))
        highest = 0x7FFFFFFF
    else:
        value, highest = int(text), 0x7FFFFFFF
    if value > highest:
        limit = "32767.99998" if "." in text else str(highest)
        raise error(at, f"got the number {text}, want at most {limit}")
    return value


def _string(text: str, at: Position) -> str:
    wrong = next((c for c in text if not 32 <= ord(c) <= 255), None)
    if wrong is not None:
        raise error(at, f"string: got the character {wrong!r}, want printable Latin-1")
    return text
