"""What is known of a source while it is compiled: names, strings, the script under way."""

import difflib
from dataclasses import dataclass, field
from typing import Literal

from gvz.wad.acs.assembler import Assembler, Label
from gvz.wad.acs.behavior import FunctionEntry, MapVariableEntry, ScriptEntry
from gvz.wad.acs.classes import ClassFlow
from gvz.wad.acs.intrinsics import Intrinsic, constants, intrinsics
from gvz.wad.acs.lexer import Position, error
from gvz.wad.acs.syntax import Function

MAX_LOCALS = 255
"""variables, or arrays, of one script or function: numbers and counts are one byte in the object file"""
MAX_STRINGS = 32768

Storage = Literal["script", "map", "global", "map array", "script array"]


@dataclass(frozen=True, slots=True, eq=False)
class VariableSymbol:
    storage: Storage
    index: int
    type: str
    size: int = 0
    """elements of an array"""

    @property
    def is_array(self) -> bool:
        return self.storage.endswith("array")


@dataclass(frozen=True, slots=True, eq=False)
class FunctionSymbol:
    number: int
    definition: Function
    parameters: tuple[VariableSymbol, ...]


@dataclass(frozen=True, slots=True)
class ConstantSymbol:
    """A named constant. A string has its text, and as value its number in the string table."""

    value: int
    text: str | None = None
    is_integer: bool = False
    """written as an integer literal, so it is no fixed-point number"""


Symbol = VariableSymbol | FunctionSymbol | ConstantSymbol | Intrinsic


@dataclass(slots=True)
class Unit:
    """Everything known about the source under compilation; the emitting functions add to it."""

    code: Assembler = field(default_factory=Assembler)
    scripts: list[ScriptEntry] = field(default_factory=list)
    script_numbers: set[int] = field(default_factory=set)
    functions: list[FunctionEntry] = field(default_factory=list)
    variables: list[MapVariableEntry] = field(default_factory=list)
    strings: dict[str, int] = field(default_factory=dict)
    names: dict[str, Symbol] = field(default_factory=dict)
    """names of the source that are known everywhere"""
    flow: ClassFlow = field(default_factory=ClassFlow)
    started_scripts: list[tuple[int, Position]] = field(default_factory=list)
    """numbers of scripts that the source starts, and where"""

    # of the script or function under compilation:
    function: Function | None = None
    """None in a script"""
    locals: dict[str, VariableSymbol] = field(default_factory=dict)
    num_locals: int = 0
    array_sizes: list[int] = field(default_factory=list)
    breaks: list[Label] = field(default_factory=list)
    """where `break` goes, of the loops and switches around the current statement"""
    continues: list[Label] = field(default_factory=list)
    """where `continue` goes, of the loops around the current statement"""

    def string(self, text: str, at: Position) -> int:
        """The number of a string, which is what stands for it in the code."""
        if text not in self.strings and len(self.strings) == MAX_STRINGS:
            raise error(at, f"got more than {MAX_STRINGS} different strings, want fewer")
        return self.strings.setdefault(text, len(self.strings))

    def lookup(self, name: str, at: Position) -> Symbol:
        """What `name` means here.

        Raises:
            AcsError: nothing of that name is declared.
        """
        symbol = self._find(name)
        if symbol is None:
            known = (*self.locals, *self.names, *constants(), *intrinsics())
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise error(at, f"got the undeclared name {name!r}, want a declared one{hint}")
        return symbol

    def declare(self, name: str, symbol: Symbol, at: Position) -> None:
        """Gives `name` a meaning in the whole source.

        Raises:
            AcsError: it has one already.
        """
        self._refuse_duplicate(name, at)
        self.names[name] = symbol

    def declare_local(self, name: str, type_name: str, at: Position, size: int = 0) -> VariableSymbol:
        """Gives `name` a meaning in this script or function: a variable, or an array of `size` elements.

        Raises:
            AcsError: it has one already, or there are too many.
        """
        if size:
            self._add_local(name, VariableSymbol("script array", len(self.array_sizes), type_name, size), at)
            self.array_sizes.append(size)
        else:
            self._add_local(name, VariableSymbol("script", self.num_locals, type_name), at)
            self.num_locals += 1
        return self.locals[name]

    def declare_parameter(self, name: str, symbol: VariableSymbol, at: Position) -> None:
        """Gives `name` a meaning in this function, for a parameter that callers already know.

        Raises:
            AcsError: it has one already, or there are too many.
        """
        self._add_local(name, symbol, at)
        self.num_locals += 1

    def forget_locals(self) -> None:
        """Ends a script or function."""
        self.function, self.locals, self.num_locals, self.array_sizes = None, {}, 0, []

    def _add_local(self, name: str, symbol: VariableSymbol, at: Position) -> None:
        self._refuse_duplicate(name, at)
        if symbol.index == MAX_LOCALS:
            raise error(at, f"got more than {MAX_LOCALS} local variables or arrays, want fewer")
        self.locals[name] = symbol

    def _find(self, name: str) -> Symbol | None:
        for names in (self.locals, self.names, intrinsics()):
            if name in names:
                return names[name]
        return ConstantSymbol(constants()[name]) if name in constants() else None

    def _refuse_duplicate(self, name: str, at: Position) -> None:
        if self._find(name) is not None:
            raise error(at, f"got {name!r} again, want a name that is not yet in use")
