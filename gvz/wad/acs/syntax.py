"""Syntax trees of the ACS subset that scenarios use. Every node knows where it stands. Data only."""

from dataclasses import dataclass

from gvz.wad.acs.lexer import Position


@dataclass(frozen=True, slots=True)
class Number:
    """A literal; `is_fixed` when written with a point."""

    at: Position
    value: int
    is_fixed: bool


@dataclass(frozen=True, slots=True)
class String:
    at: Position
    text: str


@dataclass(frozen=True, slots=True)
class Name:
    """A variable, constant or line special; with `index` an element of an array."""

    at: Position
    name: str
    index: "Expression | None" = None


@dataclass(frozen=True, slots=True)
class Call:
    """A function, built-in or line special that is executed."""

    at: Position
    name: str
    arguments: "tuple[Expression, ...]"


@dataclass(frozen=True, slots=True)
class Unary:
    at: Position
    operator: str
    operand: "Expression"


@dataclass(frozen=True, slots=True)
class Binary:
    at: Position
    operator: str
    left: "Expression"
    right: "Expression"


@dataclass(frozen=True, slots=True)
class Increment:
    """`++x`, `x++`, `--x` or `x--`, as an expression or a statement."""

    at: Position
    operator: str
    target: Name
    is_prefix: bool


Expression = Number | String | Name | Call | Unary | Binary | Increment


@dataclass(frozen=True, slots=True)
class Variable:
    """A declared variable of a script, a function or the map. `size` makes it an array."""

    at: Position
    type: str
    name: str
    size: Expression | None
    initial: Expression | tuple[Expression, ...] | None


@dataclass(frozen=True, slots=True)
class Declare:
    at: Position
    variables: tuple[Variable, ...]


@dataclass(frozen=True, slots=True)
class Assign:
    at: Position
    target: Name
    operator: str
    value: Expression


@dataclass(frozen=True, slots=True)
class Print:
    """`Print` or `Log`; parts are (format letter, value)."""

    at: Position
    function: str
    parts: tuple[tuple[str, Expression], ...]


@dataclass(frozen=True, slots=True)
class Block:
    at: Position
    statements: "tuple[Statement, ...]"


@dataclass(frozen=True, slots=True)
class If:
    """`if ... else if ... else ...`: (condition, body) of each branch, and the last `else`."""

    at: Position
    branches: "tuple[tuple[Expression, Statement], ...]"
    otherwise: "Statement | None"


@dataclass(frozen=True, slots=True)
class Loop:
    """`while` or `until`, with the test before the body, or after it (`do`)."""

    at: Position
    condition: Expression
    body: "Statement"
    is_until: bool
    test_first: bool


@dataclass(frozen=True, slots=True)
class For:
    at: Position
    initial: "Statement"
    condition: Expression
    step: "Statement"
    body: "Statement"


@dataclass(frozen=True, slots=True)
class Case:
    """A label in a switch; `value` is None for `default`."""

    at: Position
    value: Expression | None


@dataclass(frozen=True, slots=True)
class Switch:
    at: Position
    value: Expression
    body: "tuple[Statement | Case, ...]"


@dataclass(frozen=True, slots=True)
class Jump:
    """`break`, `continue`, `terminate`, `suspend` or `restart`."""

    at: Position
    keyword: str


@dataclass(frozen=True, slots=True)
class Return:
    at: Position
    value: Expression | None


Statement = Declare | Assign | Increment | Call | Print | Block | If | Loop | For | Switch | Jump | Return


@dataclass(frozen=True, slots=True)
class Define:
    """`#define NAME value`."""

    at: Position
    name: str
    value: Expression


@dataclass(frozen=True, slots=True)
class GlobalVariable:
    """`global int N:name`, shared by all maps; ViZDoom shows number N as USER variable N."""

    at: Position
    type: str
    number: int
    name: str


@dataclass(frozen=True, slots=True)
class Parameter:
    at: Position
    type: str
    name: str


@dataclass(frozen=True, slots=True)
class Script:
    at: Position
    number: Expression
    type: str
    """event that starts it, lower case; empty for a script that is called"""
    parameters: tuple[Parameter, ...]
    body: Statement


@dataclass(frozen=True, slots=True)
class Function:
    at: Position
    returns: str
    """int, bool, str or void"""
    name: str
    parameters: tuple[Parameter, ...]
    body: Block
    end: Position
    """of the closing brace"""


Declaration = Define | Declare | GlobalVariable | Script | Function
