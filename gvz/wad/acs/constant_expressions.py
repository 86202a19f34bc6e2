"""Expressions whose value must be known when the source is compiled."""

from gvz.core.errors import AcsError
from gvz.wad.acs.lexer import Position, error
from gvz.wad.acs.symbols import ConstantSymbol, Unit
from gvz.wad.acs.syntax import Binary, Expression, Name, Number, String, Unary


def constant(unit: Unit, node: Expression, what: str) -> ConstantSymbol:
    """The value of a constant expression, as a signed 32-bit number or a string; strings cannot be added up."""
    match node:
        case Number():
            return ConstantSymbol(_signed(node.value), is_integer=not node.is_fixed)
        case String():
            return ConstantSymbol(unit.string(node.text, node.at), node.text)
        case Name(index=None):
            symbol = unit.lookup(node.name, node.at)
            if isinstance(symbol, ConstantSymbol):
                return symbol
        case Unary():
            operand = constant(unit, node.operand, what)
            value = _number(operand, node.operand, what)
            result = _signed({"-": -value, "!": int(not value), "~": ~value}[node.operator])
            return ConstantSymbol(result, is_integer=operand.is_integer)
        case Binary():
            chain = [node]
            while isinstance(node.left, Binary):
                node = node.left
                chain.append(node)
            total = constant_number(unit, node.left, what)
            for link in reversed(chain):
                total = _fold(link.operator, total, constant_number(unit, link.right, what), link.at)
            return ConstantSymbol(total)
        case _:
            pass
    raise error(node.at, f"{what}: got a value known only when the script runs, want a constant")


def constant_number(unit: Unit, node: Expression, what: str) -> int:
    """The value of a constant expression that must be a number."""
    return _number(constant(unit, node, what), node, what)


def _number(result: ConstantSymbol, node: Expression, what: str) -> int:
    if result.text is not None:
        raise error(node.at, f"{what}: got a string, want a number")
    return result.value


def number_if_constant(unit: Unit, node: Expression) -> int | None:
    """The value of an expression whose code is already emitted; None if it is not constant."""
    try:
        return constant_number(unit, node, "")
    except AcsError:
        return None


def refuse_zero_divisor(unit: Unit, operator: str, node: Expression) -> None:
    """Refuses a division by the constant 0, at which the engine would end the script.

    `operator` is that of an expression or an assignment; `node` is on its right, with its code emitted already.
    """
    if operator.removesuffix("=") in ("/", "%") and number_if_constant(unit, node) == 0:
        raise error(node.at, f"got a division by zero on the right of {operator!r}, want another number")


def _signed(value: int) -> int:
    return (value + 0x80000000) % 0x100000000 - 0x80000000


def _fold(operator: str, left: int, right: int, at: Position) -> int:
    if operator in ("/", "%"):
        if right == 0:
            raise error(at, f"got a division by zero on the right of {operator!r}, want another constant")
        quotient = abs(left) // abs(right) * (1 if (left < 0) == (right < 0) else -1)
        return _signed(quotient if operator == "/" else left - quotient * right)
    results = {
        "+": lambda: left + right,
        "-": lambda: left - right,
        "*": lambda: left * right,
        "==": lambda: left == right,
        "!=": lambda: left != right,
        "<": lambda: left < right,
        ">": lambda: left > right,
        "<=": lambda: left <= right,
        ">=": lambda: left >= right,
        "&&": lambda: bool(left and right),
        "||": lambda: bool(left or right),
        "&": lambda: left & right,
        "|": lambda: left | right,
        "^": lambda: left ^ right,
        "<<": lambda: left << (right & 31),
        ">>": lambda: left >> (right & 31),
    }
    return _signed(int(results[operator]()))
