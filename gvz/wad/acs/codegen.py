"""Declarations and statements to instructions; `compile_acs`."""

from collections.abc import Collection

from gvz.wad.acs.assembler import Label
from gvz.wad.acs.behavior import FunctionEntry, MapVariableEntry, ScriptEntry, write_behavior
from gvz.wad.acs.expressions import (
    VARIABLE_OPCODES,
    constant,
    constant_number,
    emit_assign,
    emit_call,
    emit_increment,
    emit_stored_value,
    emit_value,
    flow,
    stored_kind,
)
from gvz.wad.acs.lexer import error
from gvz.wad.acs.parser import parse
from gvz.wad.acs.symbols import MAX_FUNCTIONS, MAX_MAP_VARIABLES, FunctionSymbol, Unit, VariableSymbol
from gvz.wad.acs.syntax import (
    Assign,
    Block,
    Call,
    Case,
    Declaration,
    Declare,
    Define,
    Expression,
    For,
    Function,
    GlobalVariable,
    If,
    Increment,
    Jump,
    Loop,
    Print,
    Return,
    Script,
    Statement,
    Switch,
    Variable,
)
from gvz.wad.stock import stock_actors

TERMINATE, SUSPEND, RESTART = 1, 2, 69
GOTO, IF_GOTO, DROP, IF_NOT_GOTO = 52, 53, 54, 79
RETURN_VOID, RETURN_VALUE = 205, 206
BEGIN_PRINT = 85
END_PRINT = {"print": 86, "printbold": 101, "log": 270}
PRINT_PART = {"s": 87, "d": 88, "i": 88, "c": 89, "f": 157}
SCRIPT_TYPE_NUMBERS = {"": 0, "open": 1, "respawn": 2, "death": 3, "enter": 4, "disconnect": 14}
MAX_SCRIPT_NUMBER = 32767
MAX_SCRIPT_PARAMETERS = 4
MAX_GLOBAL_VARIABLES = 64
MAX_ARRAY_SIZE = 65536
"""far above any need; a huge array would make the engine allocate it"""


def compile_acs(source: str, *, actor_classes: Collection[str] = ()) -> bytes:
    """Compiles ACS source text to the bytes of a BEHAVIOR lump.

    Args:
        source: text of a SCRIPTS lump.
        actor_classes: names of actor classes there are besides the engine's own for Doom (from the WAD's DECORATE).

    Raises:
        AcsError: the source is outside the supported subset of ACS, or would be accepted by the engine only to
            fail silently in the game: an unknown actor class, a wrong number or type of arguments.
    """
    generator = _Generator()
    behavior = generator.compile(parse(source))
    generator.unit.flow.check((*stock_actors(), *actor_classes))
    return behavior


class _Generator:
    """Emits one source's code, in source order, which is the order ACC gives numbers and strings in."""

    def __init__(self) -> None:
        self.unit = Unit()
        self._scripts: list[ScriptEntry] = []
        self._functions: list[FunctionEntry] = []
        self._variables: list[MapVariableEntry] = []
        self._breaks: list[Label] = []
        self._continues: list[Label] = []

    def compile(self, declarations: list[Declaration]) -> bytes:
        functions = [d for d in declarations if isinstance(d, Function)]
        for number, function in enumerate(functions):  # before all else: functions may be used before they stand
            self._declare_function(function, number)
        for declaration in declarations:
            self._declaration(declaration)
        strings = [text.encode("latin-1") for text in self.unit.strings]
        return write_behavior(self.unit.code.finish(), self._scripts, self._functions, strings, self._variables)

    # Declarations

    def _declare_function(self, function: Function, number: int) -> None:
        if number == MAX_FUNCTIONS:
            raise error(function.at, f"got more than {MAX_FUNCTIONS} functions, want fewer")
        parameters = tuple(VariableSymbol("script", i, p.type) for i, p in enumerate(function.parameters))
        self.unit.declare(function.name, FunctionSymbol(number, function, parameters), function.at)

    def _declaration(self, declaration: Declaration) -> None:
        match declaration:
            case Define():
                value = constant(self.unit, declaration.value, f"#define {declaration.name}")
                self.unit.declare(declaration.name, value, declaration.at)
            case Declare():
                for variable in declaration.variables:
                    self._map_variable(variable)
            case GlobalVariable():
                if declaration.number >= MAX_GLOBAL_VARIABLES:
                    raise error(
                        declaration.at,
                        f"got global variable {declaration.number}, want a number from 0 to {MAX_GLOBAL_VARIABLES - 1}",
                    )
                symbol = VariableSymbol("global", declaration.number, declaration.type)
                self.unit.declare(declaration.name, symbol, declaration.at)
            case Script():
                self._script(declaration)
            case Function():
                self._function(declaration)

    def _map_variable(self, variable: Variable) -> None:
        index = len(self._variables)
        if index == MAX_MAP_VARIABLES:
            raise error(variable.at, f"got more than {MAX_MAP_VARIABLES} map variables, want fewer")
        size = self._array_size(variable)
        symbol = VariableSymbol("map array" if size else "map", index, variable.type)
        self.unit.declare(variable.name, symbol, variable.at)
        initial = self._initial_values(variable, size)
        values = tuple(self._initial_constant(node, symbol, variable) for node in initial)
        self._variables.append(MapVariableEntry(size, values if size else values or (0,)))

    def _array_size(self, variable: Variable) -> int:
        """Number of elements; 0 for what is no array."""
        if variable.size is None:
            return 0
        size = constant_number(self.unit, variable.size, f"size of {variable.name!r}")
        if not 1 <= size <= MAX_ARRAY_SIZE:
            raise error(variable.at, f"size of {variable.name!r}: got {size}, want 1 to {MAX_ARRAY_SIZE}")
        return size

    def _initial_values(self, variable: Variable, size: int) -> tuple[Expression, ...]:
        if variable.initial is None:
            return ()
        if not isinstance(variable.initial, tuple):
            return (variable.initial,)
        if len(variable.initial) > size:
            raise error(
                variable.at, f"array {variable.name!r}: got {len(variable.initial)} values, want at most {size}"
            )
        return variable.initial

    def _initial_constant(self, node: Expression, symbol: VariableSymbol, variable: Variable) -> int:
        value = constant(self.unit, node, f"start value of {variable.name!r}")
        if value.text is None and symbol.type == "str":
            raise error(node.at, f"start value of {variable.name!r}: got a number, want a string")
        flow(self.unit, node, symbol)
        return value.value & 0xFFFFFFFF

    def _script(self, script: Script) -> None:
        number = constant_number(self.unit, script.number, "script number")
        if not 1 <= number <= MAX_SCRIPT_NUMBER:
            raise error(script.at, f"script number: got {number}, want 1 to {MAX_SCRIPT_NUMBER}")
        if any(number == other.number for other in self._scripts):
            raise error(script.at, f"got script {number} again, want another number")
        num_parameters = len(script.parameters)
        if num_parameters > MAX_SCRIPT_PARAMETERS:
            raise error(
                script.at,
                f"script {number}: got {num_parameters} parameters, want at most {MAX_SCRIPT_PARAMETERS}",
            )
        if script.type == "disconnect" and num_parameters != 1:
            raise error(script.at, f"disconnect script: got {num_parameters} parameters, want 1, the player")
        unit, address = self.unit, self.unit.code.address
        unit.begin_locals()
        for parameter in script.parameters:
            unit.declare_local(parameter.name, parameter.type, parameter.at)
        unit.code.last_opcode = 0
        self._statement(script.body)
        if unit.code.last_opcode != TERMINATE:
            unit.code.emit(TERMINATE)
        type_number = SCRIPT_TYPE_NUMBERS[script.type]
        sizes = tuple(unit.array_sizes)
        self._scripts.append(ScriptEntry(number, type_number, address, num_parameters, unit.num_locals, sizes))

    def _function(self, function: Function) -> None:
        unit, address = self.unit, self.unit.code.address
        unit.begin_locals()
        symbol = unit.names[function.name]
        assert isinstance(symbol, FunctionSymbol)
        for parameter, variable in zip(function.parameters, symbol.parameters, strict=True):
            unit.declare_parameter(parameter.name, variable, parameter.at)
        unit.function = function
        unit.code.last_opcode = 0
        self._statement(function.body)
        if unit.code.last_opcode not in (RETURN_VOID, RETURN_VALUE):
            if function.returns != "void":
                raise error(function.end, f"got the end of function {function.name!r}, want 'return' with a value")
            unit.code.emit(RETURN_VOID)
        unit.function = None
        num_parameters = len(function.parameters)
        self._functions.append(
            FunctionEntry(
                function.name,
                function.returns != "void",
                address,
                num_parameters,
                unit.num_locals - num_parameters,
                tuple(unit.array_sizes),
            )
        )

    # Statements

    def _statement(self, node: Statement) -> None:
        unit = self.unit
        match node:
            case Declare():
                for variable in node.variables:
                    self._local_variable(variable)
            case Assign():
                emit_assign(unit, node)
            case Increment():
                emit_increment(unit, node)
            case Call():
                emit_call(unit, node, discard=True)
            case Print():
                self._print(node)
            case Block():
                for statement in node.statements:
                    self._statement(statement)
            case If():
                self._if(node)
            case Loop():
                self._loop(node)
            case For():
                self._for(node)
            case Switch():
                self._switch(node)
            case Jump():
                self._jump(node)
            case Return():
                self._return(node)

    def _local_variable(self, variable: Variable) -> None:
        unit, size = self.unit, self._array_size(variable)
        symbol = unit.declare_local(variable.name, variable.type, variable.at, size)
        opcode = VARIABLE_OPCODES[symbol.storage]["="]
        for i, node in enumerate(self._initial_values(variable, size)):
            if size:
                unit.code.push(i)
            emit_stored_value(unit, node, symbol, variable.name)
            unit.code.emit(opcode, symbol.index)

    def _print(self, node: Print) -> None:
        self.unit.code.emit(BEGIN_PRINT)
        for letter, value in node.parts:
            kind = "str" if letter == "s" else "int"
            emit_value(self.unit, value, kind, f"{node.function} of {letter!r}")
            self.unit.code.emit(PRINT_PART[letter])
        self.unit.code.emit(END_PRINT[node.function])

    def _condition(self, node: Expression, opcode: int, target: Label) -> None:
        emit_value(self.unit, node, "int", "condition")
        self.unit.code.jump(opcode, target)

    def _if(self, node: If) -> None:
        code, end = self.unit.code, Label()
        for i, (condition, body) in enumerate(node.branches):
            skip = Label()
            self._condition(condition, IF_NOT_GOTO, skip)
            self._statement(body)
            if i + 1 < len(node.branches) or node.otherwise is not None:
                code.jump(GOTO, end)
            code.place(skip)
        if node.otherwise is not None:
            self._statement(node.otherwise)
        code.place(end)

    def _loop(self, node: Loop) -> None:
        code, top, test, end = self.unit.code, Label(), Label(), Label()
        code.place(top)
        if node.test_first:
            self._condition(node.condition, IF_GOTO if node.is_until else IF_NOT_GOTO, end)
            self._body(node.body, breaks=end, continues=top)
            code.jump(GOTO, top)
        else:
            self._body(node.body, breaks=end, continues=test)
            code.place(test)
            self._condition(node.condition, IF_NOT_GOTO if node.is_until else IF_GOTO, top)
        code.place(end)

    def _for(self, node: For) -> None:
        code, test, step, body, end = self.unit.code, Label(), Label(), Label(), Label()
        self._statement(node.initial)
        code.place(test)
        self._condition(node.condition, IF_GOTO, body)
        code.jump(GOTO, end)
        code.place(step)
        self._statement(node.step)
        code.jump(GOTO, test)
        code.place(body)
        self._body(node.body, breaks=end, continues=step)
        code.jump(GOTO, step)
        code.place(end)

    def _body(self, node: Statement, *, breaks: Label, continues: Label) -> None:
        self._breaks.append(breaks)
        self._continues.append(continues)
        self._statement(node)
        self._breaks.pop()
        self._continues.pop()

    def _switch(self, node: Switch) -> None:
        code, table, end = self.unit.code, Label(), Label()
        emit_value(self.unit, node.value, "any", "value of switch")
        code.jump(GOTO, table)
        cases: dict[int | None, Label] = {}
        self._breaks.append(end)
        for item in node.body:
            if not isinstance(item, Case):
                self._statement(item)
                continue
            value = None if item.value is None else constant(self.unit, item.value, "case").value
            if value in cases:
                raise error(item.at, f"got {'default' if value is None else f'case {value}'} again, want it once")
            cases[value] = Label()
            code.place(cases[value])
        self._breaks.pop()
        code.jump(GOTO, end)
        code.place(table)
        default = cases.pop(None, None)
        if cases:
            numbered = [(value, label) for value, label in cases.items() if value is not None]
            code.jump_by_case(sorted(numbered, key=lambda case: case[0]))
        code.emit(DROP)
        if default is not None:
            code.jump(GOTO, default)
        code.place(end)

    def _jump(self, node: Jump) -> None:
        code = self.unit.code
        if node.keyword in ("break", "continue"):
            targets = self._breaks if node.keyword == "break" else self._continues
            if not targets:
                raise error(node.at, f"got {node.keyword!r} outside a loop, want it in one")
            code.jump(GOTO, targets[-1])
            return
        if self.unit.function is not None:
            raise error(node.at, f"got {node.keyword!r} in a function, want 'return'")
        code.emit({"terminate": TERMINATE, "suspend": SUSPEND, "restart": RESTART}[node.keyword])

    def _return(self, node: Return) -> None:
        unit, function = self.unit, self.unit.function
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
