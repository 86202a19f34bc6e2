"""Finds the string literals that can become the name of an actor class, also through variables and functions.

The engine does not report an unknown class: Spawn returns 0, and a script that spawns until it succeeds is killed after
two million instructions. So the compiler checks the names.
"""

import difflib
from collections import defaultdict
from collections.abc import Collection, Hashable

from gvz.wad.acs.lexer import Position, error

USED_AS_CLASS = "used as class"
"""the target of every class argument of a built-in"""


class ClassFlow:
    """The flow of values between variables, arrays, parameters and functions' results in one compilation."""

    def __init__(self) -> None:
        self._sources: defaultdict[Hashable, list[Hashable]] = defaultdict(list)
        self._literals: defaultdict[Hashable, list[tuple[str, Position]]] = defaultdict(list)

    def add_literal(self, text: str, at: Position, target: Hashable) -> None:
        """The string `text` can become the value of `target`."""
        self._literals[target].append((text, at))

    def add(self, source: Hashable, target: Hashable) -> None:
        """A value of `source` can become a value of `target`."""
        self._sources[target].append(source)

    def check(self, classes: Collection[str]) -> None:
        """Refuses the first class name of the source that is not in `classes` (case is ignored)."""
        known = {name.lower(): name for name in classes}
        reached: set[Hashable] = {USED_AS_CLASS}
        pending: list[Hashable] = [USED_AS_CLASS]
        unknown: list[tuple[str, Position]] = []
        while pending:
            target = pending.pop()
            unknown += [item for item in self._literals[target] if item[0].lower() not in known]
            for source in self._sources[target]:
                if source not in reached:
                    reached.add(source)
                    pending.append(source)
        if unknown:
            text, at = min(unknown, key=lambda item: (item[1].line, item[1].column))
            near = difflib.get_close_matches(text.lower(), known, n=1)
            hint = f"; did you mean {known[near[0]]!r}?" if near else ""
            raise error(at, f"got the unknown actor class {text!r}, want one the engine or DECORATE has{hint}")
