"""Expressions, assignments and calls to instructions."""

from gvz.wad.acs.classes import USED_AS_CLASS
from gvz.wad.acs.constant_expressions import number_if_constant, refuse_zero_divisor
from gvz.wad.acs.intrinsics import FIXED_PROPERTIES, LATENT, Intrinsic, Kind, Type
from gvz.wad.acs.lexer import error
from gvz.wad.acs.symbols import ConstantSymbol, FunctionSymbol, Unit, VariableSymbol
from gvz.wad.acs.syntax import Assign, Binary, Call, Expression, Increment, Name, Number, String, Unary

PUSH = "push"
VARIABLE_OPCODES: dict[str, dict[str, int]] = {
    storage: dict(zip((PUSH, "=", "+=", "-=", "*=", "/=", "%=", "++", "--"), opcodes, strict=True))
    for storage, opcodes in {
        "script": (28, 25, 31, 34, 37, 40, 43, 46, 49),
        "map": (29, 26, 32, 35, 38, 41, 44, 47, 50),
        "global": (182, 181, 183, 184, 185, 186, 187, 188, 189),
        "map array": (207, 208, 209, 210, 211, 212, 213, 214, 215),
        "script array": (365, 364, 366, 367, 368, 369, 370, 371, 372),
    }.items()
}
"""by the scope of a variable, then by the operation"""

_BINARY = "+ 14 - 15 * 16 / 17 % 18 == 19 != 20 < 21 > 22 <= 23 >= 24 && 70 || 71 & 72 | 73 ^ 74 << 76 >> 77".split()
BINARY_OPCODES: dict[str, int] = dict(zip(_BINARY[::2], map(int, _BINARY[1::2]), strict=True))
UNARY_OPCODES = {"!": 75, "-": 78, "~": 330}
DROP, CALL, CALL_DISCARD, DUP, SWAP = 54, 203, 204, 216, 217
LSPEC_1, LSPEC_5_RESULT, CALL_FUNC = 4, 263, 351
MAX_SPECIAL_ARGUMENTS = 5


def emit_value(unit: Unit, node: Expression, kind: Kind, what: str) -> None:
    """Emits `node` where a value of `kind` is wanted, named `what` in errors; its type may be unknown."""
    if kind == "class":
        flow(unit, node, USED_AS_CLASS)
    type_name = emit_expression(unit, node)
    if type_name == "int" and kind in ("str", "class"):
        raise error(node.at, f"{what}: got a number, want a string")
    if type_name == "str" and kind in ("int", "fixed", "script"):
        raise error(node.at, f"{what}: got a string, want a number")
    if type_name == "void":
        raise error(node.at, f"{what}: got a function that returns nothing, want a value")
    if kind == "script":
        _note_script(unit, node)
    if kind == "fixed":
        _refuse_integer(unit, node, what)


def _refuse_integer(unit: Unit, node: Expression, what: str) -> None:
    """Refuses an integer literal, or a constant defined by one, for a fixed-point number; 0 is valid for both.

    Likewise for a random number between such ones.
    """
    if isinstance(node, Call) and node.name == "random":
        for end in node.arguments:
            _refuse_integer(unit, end, what)
        return
    literal = node.operand if isinstance(node, Unary) else node
    if isinstance(literal, Number):
        value = 0 if literal.is_fixed else literal.value
    else:
        symbol = _named_constant(unit, literal)
        value = symbol.value if symbol is not None and symbol.is_integer else 0
    if value:
        raise error(literal.at, f"{what}: got the integer {value}, want a fixed-point number such as {value}.0")


def _note_script(unit: Unit, node: Expression) -> None:
    value = node if isinstance(node, Number) else _named_constant(unit, node)
    if value is not None:  # else it is known only when the script runs
        unit.started_scripts.append((value.value, node.at))


def _named_constant(unit: Unit, node: Expression) -> ConstantSymbol | None:
    symbol = unit.lookup(node.name, node.at) if isinstance(node, Name) else None
    return symbol if isinstance(symbol, ConstantSymbol) else None


def emit_expression(unit: Unit, node: Expression) -> Type:
    """Emits instructions that leave the value of `node` on the stack; returns its type as far as it is known."""
    match node:
        case Number():
            unit.code.push(node.value)
            return "int"
        case String():
            unit.code.push(unit.string(node.text, node.at))
            return "str"
        case Name():
            return _emit_name(unit, node)
        case Call():
            return emit_call(unit, node, discard=False)
        case Increment():
            return _emit_increment_value(unit, node)
        case Unary():
            emit_value(unit, node.operand, "int", f"operand of {node.operator!r}")
            unit.code.emit(UNARY_OPCODES[node.operator])
            return "int"
        case Binary():
            return _emit_binary(unit, node)


def _emit_binary(unit: Unit, node: Binary) -> Type:
    # A long chain a + b + c ... is deep on the left: a loop walks it without recursion.
    chain = [node]
    while isinstance(node.left, Binary):
        node = node.left
        chain.append(node)
    # Strings can be compared: equal texts have equal numbers.
    kinds: list[Kind] = ["any" if n.operator in ("==", "!=") else "int" for n in chain]
    emit_value(unit, node.left, kinds[-1], f"left of {node.operator!r}")
    for link, kind in zip(reversed(chain), reversed(kinds), strict=True):
        emit_value(unit, link.right, kind, f"right of {link.operator!r}")
        refuse_zero_divisor(unit, link.operator, link.right)
        unit.code.emit(BINARY_OPCODES[link.operator])
    return "int"


def _emit_name(unit: Unit, node: Name) -> Type:
    symbol = unit.lookup(node.name, node.at)
    if isinstance(symbol, VariableSymbol):
        _emit_index(unit, node, symbol)
        unit.code.emit(VARIABLE_OPCODES[symbol.storage][PUSH], symbol.index)
        return _read_type(symbol.type)
    if node.index is not None:
        raise error(node.at, f"got an index on {node.name!r}, want it on an array")
    if isinstance(symbol, ConstantSymbol):
        unit.code.push(symbol.value)
        return "int" if symbol.text is None else "str"
    if isinstance(symbol, Intrinsic) and symbol.form == "special":
        unit.code.push(symbol.number)
        return "int"
    raise error(node.at, f"got the function {node.name!r} without '(', want a call or a value")


def _read_type(declared: str) -> Type:
    # An int variable may hold a string's number: old scripts pass strings through int parameters.
    return "str" if declared == "str" else "any"


def _emit_index(unit: Unit, node: Name, symbol: VariableSymbol) -> None:
    if symbol.is_array and node.index is None:
        raise error(node.at, f"got the array {node.name!r} without an index, want {node.name}[...]")
    if node.index is not None:
        if not symbol.is_array:
            raise error(node.at, f"got an index on {node.name!r}, want it on an array")
        emit_value(unit, node.index, "int", f"index of {node.name!r}")
        number = number_if_constant(unit, node.index)
        if number is not None and not 0 <= number < symbol.size:
            raise error(node.index.at, f"index of {node.name!r}: got {number}, want 0 to {symbol.size - 1}")


def _variable(unit: Unit, target: Name) -> VariableSymbol:
    symbol = unit.lookup(target.name, target.at)
    if not isinstance(symbol, VariableSymbol):
        raise error(target.at, f"got {target.name!r}, which cannot be changed, want a variable")
    return symbol


def emit_increment(unit: Unit, node: Increment) -> None:
    """Emits `x++` or the like as a statement."""
    symbol = _variable(unit, node.target)
    _emit_index(unit, node.target, symbol)
    unit.code.emit(VARIABLE_OPCODES[symbol.storage][node.operator], symbol.index)


def _emit_increment_value(unit: Unit, node: Increment) -> Type:
    symbol = _variable(unit, node.target)
    opcodes = VARIABLE_OPCODES[symbol.storage]
    _emit_index(unit, node.target, symbol)
    if symbol.is_array:
        unit.code.emit(DUP)  # the index, once for the push and once for the change
    if node.is_prefix:
        unit.code.emit(opcodes[node.operator], symbol.index)
        unit.code.emit(opcodes[PUSH], symbol.index)
    else:
        unit.code.emit(opcodes[PUSH], symbol.index)
        if symbol.is_array:
            unit.code.emit(SWAP)
        unit.code.emit(opcodes[node.operator], symbol.index)
    return "int"


def emit_assign(unit: Unit, node: Assign) -> None:
    """Emits `x = value` or a compound assignment."""
    symbol = _variable(unit, node.target)
    _emit_index(unit, node.target, symbol)
    if node.operator != "=" and symbol.type == "str":
        raise error(node.at, f"got {node.operator!r} on the string {node.target.name!r}, want '='")
    emit_stored_value(unit, node.value, symbol, node.target.name)
    refuse_zero_divisor(unit, node.operator, node.value)
    unit.code.emit(VARIABLE_OPCODES[symbol.storage][node.operator], symbol.index)


def emit_stored_value(unit: Unit, node: Expression, symbol: VariableSymbol, name: str) -> None:
    """Emits a value that is stored in the variable `name`."""
    flow(unit, node, symbol)
    emit_value(unit, node, stored_kind(symbol.type), f"value of {name!r}")


def stored_kind(declared: str) -> Kind:
    """The kind of value that a variable, parameter or result with this declared type accepts."""
    return "str" if declared == "str" else "any"


def emit_call(unit: Unit, node: Call, *, discard: bool) -> Type:
    """Emits a call; `discard` drops its result, and then the returned type has no meaning."""
    symbol = unit.lookup(node.name, node.at)
    if isinstance(symbol, FunctionSymbol):
        return _emit_function_call(unit, node, symbol, discard)
    if not isinstance(symbol, Intrinsic):
        raise error(node.at, f"got a call of {node.name!r}, want the name of a function")
    required, most = symbol.num_required, len(symbol.parameters)
    _check_count(node, symbol.name, required, most)
    if unit.function is not None and node.name in LATENT:
        raise error(node.at, f"got {symbol.name} in a function, want it in a script: only scripts can wait")
    kinds = _argument_kinds(unit, node, symbol)[: len(node.arguments)]
    for i, (argument, kind) in enumerate(zip(node.arguments, kinds, strict=True)):
        emit_value(unit, argument, kind, f"argument {i + 1} of {symbol.name}")
    _emit_intrinsic(unit, symbol, len(node.arguments), discard)
    return symbol.returns


def _emit_intrinsic(unit: Unit, symbol: Intrinsic, num_arguments: int, discard: bool) -> None:
    code = unit.code
    if symbol.form == "instruction":
        for _ in range(len(symbol.parameters) - num_arguments):
            code.push(0)
        code.emit(symbol.number)
    elif symbol.form == "function":
        code.emit_call(CALL_FUNC, num_arguments, symbol.number)
    elif discard:
        code.emit(LSPEC_1 + num_arguments - 1, symbol.number)
        return
    else:
        for _ in range(MAX_SPECIAL_ARGUMENTS - num_arguments):
            code.push(0)
        code.emit(LSPEC_5_RESULT, symbol.number)
    if discard and symbol.returns != "void":
        code.emit(DROP)


def _emit_function_call(unit: Unit, node: Call, symbol: FunctionSymbol, discard: bool) -> Type:
    definition = symbol.definition
    _check_count(node, definition.name, len(symbol.parameters), len(symbol.parameters))
    for argument, parameter, declared in zip(node.arguments, symbol.parameters, definition.parameters, strict=True):
        emit_stored_value(unit, argument, parameter, declared.name)
    unit.code.emit(CALL_DISCARD if discard else CALL, symbol.number)
    return "void" if definition.returns == "void" else _read_type(definition.returns)


def _check_count(node: Call, name: str, least: int, most: int) -> None:
    got = len(node.arguments)
    if not least <= got <= most:
        wanted = str(most) if least == most else f"{least} to {most}"
        raise error(node.at, f"{name}: got {got} arguments, want {wanted}")


def _argument_kinds(unit: Unit, node: Call, symbol: Intrinsic) -> tuple[Kind, ...]:
    """The kinds of a built-in's arguments, if one argument decides the kind of the next."""
    kinds = symbol.parameters
    if node.name == "setactorproperty":
        constant_symbol = _named_constant(unit, node.arguments[1])
        if constant_symbol is not None and constant_symbol.value in FIXED_PROPERTIES:
            return (*kinds[:2], "fixed")
    if node.name == "setthingspecial" and isinstance(node.arguments[1], Name):
        special = unit.lookup(node.arguments[1].name, node.arguments[1].at)
        if isinstance(special, Intrinsic) and special.form == "special":
            return (*kinds[:2], *special.parameters, *kinds[2 + len(special.parameters) :])
    return kinds


def flow(unit: Unit, node: Expression, target: object) -> None:
    """Notes that the value of `node` goes into `target`, for the check of class names."""
    match node:
        case String():
            unit.flow.add_literal(node.text, node.at, target)
        case Name() | Call():
            symbol = unit.lookup(node.name, node.at)
            if isinstance(symbol, ConstantSymbol):
                if symbol.text is not None:
                    unit.flow.add_literal(symbol.text, node.at, target)
            elif isinstance(symbol, VariableSymbol | FunctionSymbol):
                unit.flow.add(symbol, target)
        case _:
            pass  # a number is not a class name
