"""Statements to instructions."""

from gvz.wad.acs import syntax
from gvz.wad.acs.assembler import Label
from gvz.wad.acs.constant_expressions import constant, constant_number
from gvz.wad.acs.expressions import (
    VARIABLE_OPCODES,
    emit_assign,
    emit_call,
    emit_increment,
    emit_stored_value,
    emit_value,
    flow,
    stored_kind,
)
from gvz.wad.acs.lexer import error
from gvz.wad.acs.symbols import Unit

TERMINATE, SUSPEND, RESTART = 1, 2, 69
GOTO, IF_GOTO, DROP, IF_NOT_GOTO = 52, 53, 54, 79
RETURN_VOID, RETURN_VALUE = 205, 206
BEGIN_PRINT = 85
END_PRINT = {"print": 86, "printbold": 101, "log": 270}
PRINT_PART = {"s": 87, "d": 88, "i": 88, "c": 89, "f": 157}
MAX_ARRAY_SIZE = 65536
"""far more than any script needs; the engine would allocate a huge array"""


def emit_statement(unit: Unit, node: syntax.Statement) -> None:
    """Emits one statement, which must make sense where it stands."""
    match node:
        case syntax.Declare():
            for variable in node.variables:
                _emit_local_variable(unit, variable)
        case syntax.Assign():
            emit_assign(unit, node)
        case syntax.Increment():
            emit_increment(unit, node)
        case syntax.Call():
            emit_call(unit, node, discard=True)
        case syntax.Print():
            _emit_print(unit, node)
        case syntax.Block():
            for statement in node.statements:
                emit_statement(unit, statement)
        case syntax.If():
            _emit_if(unit, node)
        case syntax.Loop():
            _emit_loop(unit, node)
        case syntax.For():
            _emit_for(unit, node)
        case syntax.Switch():
            _emit_switch(unit, node)
        case syntax.Jump():
            _emit_jump(unit, node)
        case syntax.Return():
            _emit_return(unit, node)


def _emit_local_variable(unit: Unit, variable: syntax.Variable) -> None:
    size = array_size(unit, variable)
    symbol = unit.declare_local(variable.name, variable.type, variable.at, size)
    opcode = VARIABLE_OPCODES[symbol.storage]["="]
    for i, node in enumerate(initial_values(variable, size)):
        if size:
            unit.code.push(i)
        emit_stored_value(unit, node, symbol, variable.name)
        unit.code.emit(opcode, symbol.index)


def array_size(unit: Unit, variable: syntax.Variable) -> int:
    """Number of elements of a declared variable; 0 if it is not an array."""
    if variable.size is None:
        return 0
    size = constant_number(unit, variable.size, f"size of {variable.name!r}")
    if not 1 <= size <= MAX_ARRAY_SIZE:
        raise error(variable.at, f"size of {variable.name!r}: got {size}, want 1 to {MAX_ARRAY_SIZE}")
    return size


def initial_values(variable: syntax.Variable, size: int) -> tuple[syntax.Expression, ...]:
    """The initial values of a declared variable or array of `size` elements; none if it starts at zero."""
    if variable.initial is None:
        return ()
    if not isinstance(variable.initial, tuple):
        return (variable.initial,)
    if len(variable.initial) > size:
        raise error(variable.at, f"array {variable.name!r}: got {len(variable.initial)} values, want at most {size}")
    return variable.initial


def _emit_print(unit: Unit, node: syntax.Print) -> None:
    unit.code.emit(BEGIN_PRINT)
    for letter, value in node.parts:
        emit_value(unit, value, "str" if letter == "s" else "int", f"{node.function} of {letter!r}")
        unit.code.emit(PRINT_PART[letter])
    unit.code.emit(END_PRINT[node.function])


def _emit_condition(unit: Unit, node: syntax.Expression, opcode: int, target: Label) -> None:
    emit_value(unit, node, "int", "condition")
    unit.code.jump(opcode, target)


def _emit_if(unit: Unit, node: syntax.If) -> None:
    end = Label()
    for i, (condition, body) in enumerate(node.branches):
        skip = Label()
        _emit_condition(unit, condition, IF_NOT_GOTO, skip)
        emit_statement(unit, body)
        if i + 1 < len(node.branches) or node.otherwise is not None:
            unit.code.jump(GOTO, end)
        unit.code.place(skip)
    if node.otherwise is not None:
        emit_statement(unit, node.otherwise)
    unit.code.place(end)


def _emit_loop(unit: Unit, node: syntax.Loop) -> None:
    code, top, test, end = unit.code, Label(), Label(), Label()
    code.place(top)
    if node.test_first:
        _emit_condition(unit, node.condition, IF_GOTO if node.is_until else IF_NOT_GOTO, end)
        _emit_body(unit, node.body, breaks=end, continues=top)
        code.jump(GOTO, top)
    else:
        _emit_body(unit, node.body, breaks=end, continues=test)
        code.place(test)
        _emit_condition(unit, node.condition, IF_NOT_GOTO if node.is_until else IF_GOTO, top)
    code.place(end)


def _emit_for(unit: Unit, node: syntax.For) -> None:
    code, test, step, body, end = unit.code, Label(), Label(), Label(), Label()
    emit_statement(unit, node.initial)
    code.place(test)
    _emit_condition(unit, node.condition, IF_GOTO, body)
    code.jump(GOTO, end)
    code.place(step)
    emit_statement(unit, node.step)
    code.jump(GOTO, test)
    code.place(body)
    _emit_body(unit, node.body, breaks=end, continues=step)
    code.jump(GOTO, step)
    code.place(end)


def _emit_body(unit: Unit, node: syntax.Statement, *, breaks: Label, continues: Label) -> None:
    unit.breaks.append(breaks)
    unit.continues.append(continues)
    emit_statement(unit, node)
    unit.breaks.pop()
    unit.continues.pop()


def _emit_switch(unit: Unit, node: syntax.Switch) -> None:
    code, table, end = unit.code, Label(), Label()
    emit_value(unit, node.value, "any", "value of switch")
    code.jump(GOTO, table)
    cases: dict[int, Label] = {}
    default: Label | None = None
    unit.breaks.append(end)
    for item in node.body:
        if not isinstance(item, syntax.Case):
            emit_statement(unit, item)
            continue
        label = Label()
        code.place(label)
        if item.value is None:
            if default is not None:
                raise error(item.at, "got default again, want it once")
            default = label
        else:
            value = constant(unit, item.value, "case").value
            if value in cases:
                raise error(item.at, f"got case {value} again, want it once")
            cases[value] = label
    unit.breaks.pop()
    code.jump(GOTO, end)
    code.place(table)
    if cases:
        code.jump_by_case(sorted(cases.items(), key=lambda case: case[0]))
    code.emit(DROP)
    if default is not None:
        code.jump(GOTO, default)
    code.place(end)


def _emit_jump(unit: Unit, node: syntax.Jump) -> None:
    if node.keyword in ("break", "continue"):
        targets = unit.breaks if node.keyword == "break" else unit.continues
        if not targets:
            raise error(node.at, f"got {node.keyword!r} outside a loop, want it in one")
        unit.code.jump(GOTO, targets[-1])
        return
    if unit.function is not None:
        raise error(node.at, f"got {node.keyword!r} in a function, want 'return'")
    unit.code.emit({"terminate": TERMINATE, "suspend": SUSPEND, "restart": RESTART}[node.keyword])


def _emit_return(unit: Unit, node: syntax.Return) -> None:
    function = unit.function
    if function is None:
        raise error(node.at, "got 'return' in a script, want 'terminate'")
    if function.returns == "void":
        if node.value is not None:
            raise error(node.at, f"got a value, want none: function {function.name!r} is void")
        unit.code.emit(RETURN_VOID)
        return
    if node.value is None:
        raise error(node.at, f"got no value, want one: function {function.name!r} returns {function.returns}")
    flow(unit, node.value, unit.names[function.name])
    emit_value(unit, node.value, stored_kind(function.returns), f"result of {function.name!r}")
    unit.code.emit(RETURN_VALUE)
