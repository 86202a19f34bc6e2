"""A cursor over tokens, with the errors of a parser."""

from collections.abc import Callable
from typing import TypeVar

from gvz.core.errors import AcsError
from gvz.wad.acs.lexer import Position, Token, error

MAX_NESTING = 64
"""nested statements and operands; keeps every recursion over a tree far from Python's limit"""

TYPES = ("int", "str", "bool")
SCRIPT_TYPES = ("open", "enter", "respawn", "death", "disconnect")
KEYWORDS = frozenset(
    (
        *TYPES,
        *SCRIPT_TYPES,
        *("void", "global", "script", "function", "if", "else", "while", "until", "do", "for", "switch"),
        *("case", "default", "break", "continue", "return", "terminate", "suspend", "restart"),
        *("print", "printbold", "log"),
    )
)
"""words that cannot be names"""

T = TypeVar("T")


class Cursor:
    """A parser's position in its tokens."""

    def __init__(self, tokens: list[Token]):
        self._tokens = tokens
        self._next = 0
        self._depth = 0

    @property
    def token(self) -> Token:
        """The token that is read next."""
        return self._tokens[self._next]

    @property
    def at(self) -> Position:
        return self.token.at

    @property
    def last(self) -> Token:
        """The token read last."""
        return self._tokens[self._next - 1]

    def is_call(self) -> bool:
        """Whether the next token but one opens parentheses."""
        following = self._tokens[min(self._next + 1, len(self._tokens) - 1)]
        return following.kind == "symbol" and following.text == "("

    def advance(self) -> Token:
        """Reads a token; stays at the end token."""
        token = self.token
        if token.kind != "end":
            self._next += 1
        return token

    def sees(self, *texts: str) -> bool:
        """Whether the next token is one of these words or symbols."""
        return self.token.kind in ("name", "symbol") and self.token.text in texts

    def accept(self, *texts: str) -> Token | None:
        """Reads one of these words or symbols, if it comes next."""
        return self.advance() if self.sees(*texts) else None

    def expect(self, *texts: str) -> Token:
        """Reads one of these words or symbols, which must come next."""
        if not self.sees(*texts):
            raise self.unexpected(" or ".join(repr(text) for text in texts))
        return self.advance()

    def identifier(self, what: str) -> Token:
        """Reads the name of a `what`, which is no keyword."""
        if self.token.kind != "name":
            raise self.unexpected(f"the name of a {what}")
        if self.token.text in KEYWORDS:
            raise error(self.at, f"got the keyword {self.token.text!r}, want the name of a {what}")
        return self.advance()

    def unexpected(self, wanted: str) -> AcsError:
        """The error that the next token is not `wanted`."""
        return error(self.at, f"got {self.token}, want {wanted}")

    def comma_list(self, item: Callable[["Cursor"], T]) -> tuple[T, ...]:
        """Reads one or more of what `item` reads, with commas between them."""
        items = [item(self)]
        while self.accept(","):
            items.append(item(self))
        return tuple(items)

    def descend(self) -> None:
        """Enters a level of nesting, at most MAX_NESTING; `ascend` leaves it."""
        self._depth += 1
        if self._depth > MAX_NESTING:
            raise error(self.at, f"nested too deeply: got {self._depth} levels, want at most {MAX_NESTING}")

    def ascend(self) -> None:
        self._depth -= 1
