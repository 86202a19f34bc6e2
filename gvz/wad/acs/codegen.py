"""Declarations to an object file; `compile_acs`."""

from collections.abc import Collection

from gvz.wad.acs import syntax
from gvz.wad.acs.behavior import FunctionEntry, MapVariableEntry, ScriptEntry, write_behavior
from gvz.wad.acs.constant_expressions import constant, constant_number
from gvz.wad.acs.expressions import flow
from gvz.wad.acs.lexer import error
from gvz.wad.acs.parser import parse
from gvz.wad.acs.statements import RETURN_VALUE, RETURN_VOID, TERMINATE, array_size, emit_statement, initial_values
from gvz.wad.acs.symbols import FunctionSymbol, Unit, VariableSymbol
from gvz.wad.stock import stock_actors

SCRIPT_TYPE_NUMBERS = {"": 0, "open": 1, "respawn": 2, "death": 3, "enter": 4, "disconnect": 14}
MAX_SCRIPT_NUMBER = 32767
MAX_SCRIPT_PARAMETERS = 4
MAX_FUNCTIONS = 256
MAX_GLOBAL_VARIABLES = 64
MAX_MAP_VARIABLES = 128


def compile_acs(source: str, *, actor_classes: Collection[str] = ()) -> bytes:
    """Compiles ACS source text to the bytes of a BEHAVIOR lump.

    Args:
        source: text of a SCRIPTS lump.
        actor_classes: names of actor classes besides the engine's own for Doom (from the WAD's DECORATE).

    Raises:
        AcsError: the source is outside the supported subset of ACS, or it would fail silently in the game: an
            unknown actor class, a missing script, a wrong number or type of arguments.
    """
    unit = Unit()
    declarations = parse(source)
    # Functions may be used before their definition.
    functions = (declaration for declaration in declarations if isinstance(declaration, syntax.Function))
    for number, function in enumerate(functions):
        _declare_function(unit, function, number)
    # In source order, which is the order in which ACC numbers variables and strings.
    for declaration in declarations:
        _emit_declaration(unit, declaration)
    _check_started_scripts(unit)
    unit.flow.check((*stock_actors(), *actor_classes))
    strings = [text.encode("latin-1") for text in unit.strings]
    return write_behavior(unit.code.finish(), unit.scripts, unit.functions, strings, unit.variables)


def _declare_function(unit: Unit, function: syntax.Function, number: int) -> None:
    if number == MAX_FUNCTIONS:
        raise error(function.at, f"got more than {MAX_FUNCTIONS} functions, want fewer")
    parameters = tuple(VariableSymbol("script", i, p.type) for i, p in enumerate(function.parameters))
    unit.declare(function.name, FunctionSymbol(number, function, parameters), function.at)


def _check_started_scripts(unit: Unit) -> None:
    for number, at in unit.started_scripts:
        if number not in unit.script_numbers:
            raise error(at, f"got script {number}, which is not there, want one of {sorted(unit.script_numbers)}")


def _emit_declaration(unit: Unit, declaration: syntax.Declaration) -> None:
    match declaration:
        case syntax.Define():
            value = constant(unit, declaration.value, f"#define {declaration.name}")
            unit.declare(declaration.name, value, declaration.at)
        case syntax.Declare():
            for variable in declaration.variables:
                _add_map_variable(unit, variable)
        case syntax.GlobalVariable():
            _declare_global_variable(unit, declaration)
        case syntax.Script():
            _emit_script(unit, declaration)
        case syntax.Function():
            _emit_function(unit, declaration)


def _declare_global_variable(unit: Unit, variable: syntax.GlobalVariable) -> None:
    if variable.number >= MAX_GLOBAL_VARIABLES:
        raise error(
            variable.at,
            f"got global variable {variable.number}, want a number from 0 to {MAX_GLOBAL_VARIABLES - 1}",
        )
    unit.declare(variable.name, VariableSymbol("global", variable.number, variable.type), variable.at)


def _add_map_variable(unit: Unit, variable: syntax.Variable) -> None:
    index = len(unit.variables)
    if index == MAX_MAP_VARIABLES:
        raise error(variable.at, f"got more than {MAX_MAP_VARIABLES} map variables, want fewer")
    size = array_size(unit, variable)
    symbol = VariableSymbol("map array" if size else "map", index, variable.type, size)
    unit.declare(variable.name, symbol, variable.at)
    initial = initial_values(variable, size)
    values = tuple(_initial_constant(unit, node, symbol, variable.name) for node in initial)
    unit.variables.append(MapVariableEntry(size, values if size else values or (0,)))


def _initial_constant(unit: Unit, node: syntax.Expression, symbol: VariableSymbol, name: str) -> int:
    value = constant(unit, node, f"start value of {name!r}")
    if value.text is None and symbol.type == "str":
        raise error(node.at, f"start value of {name!r}: got a number, want a string")
    flow(unit, node, symbol)
    return value.value & 0xFFFFFFFF


def _emit_script(unit: Unit, script: syntax.Script) -> None:
    number = constant_number(unit, script.number, "script number")
    if not 1 <= number <= MAX_SCRIPT_NUMBER:
        raise error(script.at, f"script number: got {number}, want 1 to {MAX_SCRIPT_NUMBER}")
    if number in unit.script_numbers:
        raise error(script.at, f"got script {number} again, want another number")
    unit.script_numbers.add(number)
    num_parameters = len(script.parameters)
    if num_parameters > MAX_SCRIPT_PARAMETERS:
        raise error(
            script.at, f"script {number}: got {num_parameters} parameters, want at most {MAX_SCRIPT_PARAMETERS}"
        )
    if script.type == "disconnect" and num_parameters != 1:
        raise error(script.at, f"disconnect script: got {num_parameters} parameters, want 1, the player")
    address = unit.code.address
    for parameter in script.parameters:
        unit.declare_local(parameter.name, parameter.type, parameter.at)
    unit.code.begin_body()
    emit_statement(unit, script.body)
    if unit.code.last_opcode != TERMINATE:
        unit.code.emit(TERMINATE)
    type_number, sizes = SCRIPT_TYPE_NUMBERS[script.type], tuple(unit.array_sizes)
    unit.scripts.append(ScriptEntry(number, type_number, address, num_parameters, unit.num_locals, sizes))
    unit.forget_locals()


def _emit_function(unit: Unit, function: syntax.Function) -> None:
    symbol = unit.names[function.name]
    assert isinstance(symbol, FunctionSymbol)
    address = unit.code.address
    unit.function = function
    for parameter, variable in zip(function.parameters, symbol.parameters, strict=True):
        unit.declare_parameter(parameter.name, variable, parameter.at)
    unit.code.begin_body()
    emit_statement(unit, function.body)
    returns = function.returns != "void"
    if unit.code.last_opcode not in (RETURN_VOID, RETURN_VALUE):
        if returns:
            raise error(function.end, f"got the end of function {function.name!r}, want 'return' with a value")
        unit.code.emit(RETURN_VOID)
    num_parameters, sizes = len(function.parameters), tuple(unit.array_sizes)
    num_locals = unit.num_locals - num_parameters
    unit.functions.append(FunctionEntry(function.name, returns, address, num_parameters, num_locals, sizes))
    unit.forget_locals()
