"""Syntax trees of the ACS subset that scenarios use. Data only."""

from msgspec import Struct

from gvz.wad.acs.lexer import Position


class Node(Struct, frozen=True):
    """Every node has its position."""

    at: Position


class Number(Node, frozen=True):
    """A literal; `is_fixed` if it is written with a point."""

    value: int
    is_fixed: bool


class String(Node, frozen=True):
    text: str


class Name(Node, frozen=True):
    """A variable, constant or line special; with `index` an element of an array."""

    name: str
    index: "Expression | None" = None


class Call(Node, frozen=True):
    """A function, built-in or line special that is executed."""

    name: str
    arguments: "tuple[Expression, ...]"


class Unary(Node, frozen=True):
    operator: str
    operand: "Expression"


class Binary(Node, frozen=True):
    operator: str
    left: "Expression"
    right: "Expression"


class Increment(Node, frozen=True):
    """`++x`, `x++`, `--x` or `x--`, as an expression or a statement."""

    operator: str
    target: Name
    is_prefix: bool


Expression = Number | String | Name | Call | Unary | Binary | Increment


class Variable(Node, frozen=True):
    """A declared variable of a script, a function or the map. `size` makes it an array."""

    type: str
    name: str
    size: Expression | None
    initial: Expression | tuple[Expression, ...] | None


class Declare(Node, frozen=True):
    variables: tuple[Variable, ...]


class Assign(Node, frozen=True):
    target: Name
    operator: str
    value: Expression


class Print(Node, frozen=True):
    """`Print` or `Log`; parts are (format letter, value)."""

    function: str
    parts: tuple[tuple[str, Expression], ...]


class Block(Node, frozen=True):
    statements: "tuple[Statement, ...]"


class If(Node, frozen=True):
    """`if ... else if ... else ...`: (condition, body) of each branch, and the last `else`."""

    branches: "tuple[tuple[Expression, Statement], ...]"
    otherwise: "Statement | None"


class Loop(Node, frozen=True):
    """`while` or `until`, with the test before the body, or after it (`do`)."""

    condition: Expression
    body: "Statement"
    is_until: bool
    test_first: bool


class For(Node, frozen=True):
    initial: "Statement"
    condition: Expression
    step: "Statement"
    body: "Statement"


class Case(Node, frozen=True):
    """A label in a switch; `value` is None for `default`."""

    value: Expression | None


class Switch(Node, frozen=True):
    value: Expression
    body: "tuple[Statement | Case, ...]"


class Jump(Node, frozen=True):
    """`break`, `continue`, `terminate`, `suspend` or `restart`."""

    keyword: str


class Return(Node, frozen=True):
    value: Expression | None


Statement = Declare | Assign | Increment | Call | Print | Block | If | Loop | For | Switch | Jump | Return


class Define(Node, frozen=True):
    """`#define NAME value`."""

    name: str
    value: Expression


class GlobalVariable(Node, frozen=True):
    """`global int N:name`, shared by all maps; ViZDoom shows number N as USER variable N."""

    type: str
    number: int
    name: str


class Parameter(Node, frozen=True):
    type: str
    name: str


class Script(Node, frozen=True):
    number: Expression
    type: str
    """event that starts the script, lower case; empty for a script that is called"""
    parameters: tuple[Parameter, ...]
    body: Statement


class Function(Node, frozen=True):
    returns: str
    """int, bool, str or void"""
    name: str
    parameters: tuple[Parameter, ...]
    body: Block
    end: Position
    """of the closing brace"""


Declaration = Define | Declare | GlobalVariable | Script | Function
