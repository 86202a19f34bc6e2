"""What names mean while a source is compiled: variables, functions, constants, the string table."""

import difflib
from dataclasses import dataclass, field
from typing import Literal

from gvz.wad.acs.assembler import Assembler
from gvz.wad.acs.classes import ClassFlow
from gvz.wad.acs.intrinsics import Intrinsic, constants, intrinsics
from gvz.wad.acs.lexer import Position, error
from gvz.wad.acs.syntax import Function

MAX_LOCALS = 255
"""variables, or arrays, of one script or function: numbers and counts are one byte in the object file"""
MAX_MAP_VARIABLES = 128
MAX_FUNCTIONS = 256
MAX_STRINGS = 32768

Storage = Literal["script", "map", "global", "map array", "script array"]


@dataclass(frozen=True, slots=True, eq=False)
class VariableSymbol:
    storage: Storage
    index: int
    type: str

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


Symbol = VariableSymbol | FunctionSymbol | ConstantSymbol | Intrinsic


@dataclass(slots=True)
class Unit:
    """Everything known about the source under compilation."""

    code: Assembler = field(default_factory=Assembler)
    strings: dict[str, int] = field(default_factory=dict)
    flow: ClassFlow = field(default_factory=ClassFlow)
    names: dict[str, Symbol] = field(default_factory=dict)
    """names of the source that are known everywhere"""
    locals: dict[str, VariableSymbol] = field(default_factory=dict)
    """names of the script or function under compilation"""
    num_locals: int = 0
    array_sizes: list[int] = field(default_factory=list)
    """of the local arrays so far"""
    function: Function | None = None
    """the function under compilation; None in a script"""

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
        """Gives `name` a meaning in the whole source."""
        self._refuse_duplicate(name, at)
        self.names[name] = symbol

    def declare_local(self, name: str, type_name: str, at: Position, size: int = 0) -> VariableSymbol:
        """Gives `name` a meaning in this script or function: a variable, or an array of `size` elements."""
        self._refuse_duplicate(name, at)
        count = len(self.array_sizes) if size else self.num_locals
        if count == MAX_LOCALS:
            raise error(at, f"got more than {MAX_LOCALS} local variables or arrays, want fewer")
        symbol = VariableSymbol("script array" if size else "script", count, type_name)
        self.locals[name] = symbol
        if size:
            self.array_sizes.append(size)
        else:
            self.num_locals += 1
        return symbol

    def declare_parameter(self, name: str, symbol: VariableSymbol, at: Position) -> None:
        """Gives `name` a meaning in this function, for a parameter that callers already know."""
        self._refuse_duplicate(name, at)
        self.locals[name] = symbol
        self.num_locals += 1

    def begin_locals(self) -> None:
        """Forgets the names of the last script or function."""
        self.locals, self.array_sizes, self.num_locals = {}, [], 0

    def _find(self, name: str) -> Symbol | None:
        for names in (self.locals, self.names, intrinsics()):
            if name in names:
                return names[name]
        return ConstantSymbol(constants()[name]) if name in constants() else None

    def _refuse_duplicate(self, name: str, at: Position) -> None:
        if self._find(name) is not None:
            raise error(at, f"got {name!r} again, want a name that is not yet in use")
