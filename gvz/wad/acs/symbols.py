"""The compiler's knowledge about a source: names, strings, the current script."""

from dataclasses import dataclass, field
from typing import Literal

from gvz.core.errors import nearest
from gvz.wad.acs.assembler import Assembler, Label
from gvz.wad.acs.behavior import FunctionEntry, MapVariableEntry, ScriptEntry
from gvz.wad.acs.classes import ClassFlow
from gvz.wad.acs.intrinsics import Intrinsic, constants, intrinsics
from gvz.wad.acs.lexer import Position, error
from gvz.wad.acs.syntax import Function

MAX_LOCALS = 255
"""variables, or arrays, of one script or function: indices and counts are one byte in the object file"""
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
    """A named constant. The value of a string is its number in the string table."""

    value: int
    text: str | None = None
    is_integer: bool = False
    """written as an integer literal, so it is not a fixed-point number"""


Symbol = VariableSymbol | FunctionSymbol | ConstantSymbol | Intrinsic


@dataclass(slots=True)
class Unit:
    """All knowledge about the compiled source; the emitting functions add to it."""

    code: Assembler = field(default_factory=Assembler)
    scripts: list[ScriptEntry] = field(default_factory=list)
    script_numbers: set[int] = field(default_factory=set)
    functions: list[FunctionEntry] = field(default_factory=list)
    variables: list[MapVariableEntry] = field(default_factory=list)
    strings: dict[str, int] = field(default_factory=dict)
    names: dict[str, Symbol] = field(default_factory=dict)
    """names that are visible in the whole source"""
    flow: ClassFlow = field(default_factory=ClassFlow)
    started_scripts: list[tuple[int, Position]] = field(default_factory=list)
    """numbers of scripts that the source starts, and where"""

    # of the current script or function:
    function: Function | None = None
    """None in a script"""
    locals: dict[str, VariableSymbol] = field(default_factory=dict)
    num_locals: int = 0
    array_sizes: list[int] = field(default_factory=list)
    breaks: list[Label] = field(default_factory=list)
    """targets of `break` in the loops and switches around the current statement"""
    continues: list[Label] = field(default_factory=list)
    """targets of `continue` in the loops around the current statement"""

    def string(self, text: str, at: Position) -> int:
        """The number of a string, which represents it in the code."""
        if text not in self.strings and len(self.strings) == MAX_STRINGS:
            raise error(at, f"got more than {MAX_STRINGS} different strings, want fewer")
        return self.strings.setdefault(text, len(self.strings))

    def lookup(self, name: str, at: Position) -> Symbol:
        """The meaning of `name` at this place, which must have one."""
        symbol = self._find(name)
        if symbol is None:
            known = (*self.locals, *self.names, *constants(), *intrinsics())
            raise error(at, f"got the undeclared name {name!r}{nearest(name, known)}, want a declared one")
        return symbol

    def declare(self, name: str, symbol: Symbol, at: Position) -> None:
        """Gives `name` a meaning in the whole source, which it must not have yet."""
        self._refuse_duplicate(name, at)
        self.names[name] = symbol

    def declare_local(self, name: str, type_name: str, at: Position, size: int = 0) -> VariableSymbol:
        """Gives `name` a meaning in this script or function: a variable, or an array of `size` elements."""
        if size:
            self._add_local(name, VariableSymbol("script array", len(self.array_sizes), type_name, size), at)
            self.array_sizes.append(size)
        else:
            self._add_local(name, VariableSymbol("script", self.num_locals, type_name), at)
            self.num_locals += 1
        return self.locals[name]

    def declare_parameter(self, name: str, symbol: VariableSymbol, at: Position) -> None:
        """Gives `name` a meaning in this function, for a parameter that callers already know."""
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
