"""Tokens to the syntax trees of declarations and statements. Knows the grammar of ACS, but no name's meaning."""

from gvz.wad.acs.cursor import KEYWORDS, SCRIPT_TYPES, TYPES, Cursor
from gvz.wad.acs.expression_parser import parse_call, parse_expression, parse_parenthesized, parse_target
from gvz.wad.acs.lexer import Position, error, tokenize
from gvz.wad.acs.syntax import (
    Assign,
    Block,
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
    Name,
    Number,
    Parameter,
    Print,
    Return,
    Script,
    Statement,
    Switch,
    Variable,
)

ASSIGNMENTS = ("=", "+=", "-=", "*=", "/=", "%=")


def parse(source: str) -> list[Declaration]:
    """Reads ACS source text.

    Raises:
        AcsError: text that is not of the subset; says what stands there and what could.
    """
    cursor = Cursor(tokenize(source))
    declarations: list[Declaration] = []
    while cursor.token.kind != "end":
        declaration = _parse_declaration(cursor)
        if declaration is not None:
            declarations.append(declaration)
    return declarations


# Declarations


def _parse_declaration(cursor: Cursor) -> Declaration | None:
    """One declaration outside scripts and functions; None for an `#include`."""
    at = cursor.at
    if cursor.accept("#"):
        return _parse_directive(cursor, at)
    if cursor.accept("global"):
        return _parse_global_variable(cursor, at)
    if cursor.accept("script"):
        return _parse_script(cursor, at)
    if cursor.accept("function"):
        return _parse_function(cursor, at)
    if cursor.sees(*TYPES):
        declare = _parse_declare(cursor)
        cursor.expect(";")
        return declare
    raise cursor.unexpected("'script', 'function', 'global', 'int', 'str', 'bool' or '#'")


def _parse_directive(cursor: Cursor, at: Position) -> Define | None:
    if cursor.accept("define"):
        name = cursor.identifier("constant")
        return Define(at, name.text, parse_expression(cursor))
    cursor.expect("include")
    file = cursor.advance()
    # The contents of zcommon.acs (built-ins, line specials, constants) are always known.
    if file.kind != "string" or file.text.lower() != "zcommon.acs":
        raise error(file.at, f'#include: got {file}, want "zcommon.acs"')
    return None


def _parse_global_variable(cursor: Cursor, at: Position) -> GlobalVariable:
    type_name = cursor.expect(*TYPES).text
    if cursor.token.kind != "number":
        raise cursor.unexpected("the number of a global variable")
    number = cursor.advance().value
    cursor.expect(":")
    name = cursor.identifier("global variable").text
    cursor.expect(";")
    return GlobalVariable(at, type_name, number, name)


def _parse_script(cursor: Cursor, at: Position) -> Script:
    if cursor.token.kind == "number":
        token = cursor.advance()
        number: Expression = Number(token.at, token.value, "." in token.text)
    else:
        token = cursor.identifier("script number's constant")
        number = Name(token.at, token.text)
    parameters: tuple[Parameter, ...] = ()
    if cursor.sees("("):
        parameters = _parse_parameters(cursor)
        event = cursor.accept("disconnect")
    else:
        event = cursor.expect("(", *SCRIPT_TYPES)
    return Script(at, number, event.text if event else "", parameters, _parse_statement(cursor))


def _parse_function(cursor: Cursor, at: Position) -> Function:
    returns = cursor.expect(*TYPES, "void").text
    name = cursor.identifier("function").text
    parameters = _parse_parameters(cursor)
    body = _parse_block(cursor)
    return Function(at, returns, name, parameters, body, end=cursor.last.at)


def _parse_parameters(cursor: Cursor) -> tuple[Parameter, ...]:
    cursor.expect("(")
    parameters = () if cursor.accept("void") else cursor.comma_list(_parse_parameter)
    cursor.expect(")")
    return parameters


def _parse_parameter(cursor: Cursor) -> Parameter:
    type_name = cursor.expect(*TYPES)
    return Parameter(type_name.at, type_name.text, cursor.identifier("parameter").text)


def _parse_declare(cursor: Cursor) -> Declare:
    type_name = cursor.expect(*TYPES)
    return Declare(type_name.at, cursor.comma_list(lambda cursor: _parse_variable(cursor, type_name.text)))


def _parse_variable(cursor: Cursor, type_name: str) -> Variable:
    name = cursor.identifier("variable")
    size, initial = None, None
    if cursor.accept("["):
        size = parse_expression(cursor)
        cursor.expect("]")
    if cursor.accept("="):
        initial = parse_expression(cursor) if size is None else _parse_array_values(cursor)
    return Variable(name.at, type_name, name.text, size, initial)


def _parse_array_values(cursor: Cursor) -> tuple[Expression, ...]:
    cursor.expect("{")
    values: list[Expression] = []
    while not cursor.sees("}"):
        values.append(parse_expression(cursor))
        if not cursor.accept(","):
            break
    cursor.expect("}")
    return tuple(values)


# Statements


def _parse_statement(cursor: Cursor) -> Statement:
    cursor.descend()
    statement = _parse_compound_statement(cursor)
    if statement is None:
        statement = _parse_simple_statement(cursor)
        cursor.expect(";")
    cursor.ascend()
    return statement


def _parse_compound_statement(cursor: Cursor) -> Statement | None:
    """A statement that no ';' has to end; None if another comes next."""
    at = cursor.at
    if cursor.sees("{"):
        return _parse_block(cursor)
    if cursor.accept(";"):
        return Block(at, ())
    if cursor.accept("if"):
        return _parse_if(cursor, at)
    if cursor.sees("while", "until"):
        is_until = cursor.advance().text == "until"
        return Loop(at, parse_parenthesized(cursor), _parse_statement(cursor), is_until, test_first=True)
    if cursor.accept("for"):
        return _parse_for(cursor, at)
    if cursor.accept("switch"):
        return _parse_switch(cursor, at)
    return None


def _parse_simple_statement(cursor: Cursor) -> Statement:
    """A statement that a ';' ends (or, as the step of a `for`, a ')')."""
    at = cursor.at
    if cursor.sees(*TYPES):
        return _parse_declare(cursor)
    if cursor.sees("break", "continue", "terminate", "suspend", "restart"):
        return Jump(at, cursor.advance().text)
    if cursor.accept("return"):
        return Return(at, None if cursor.sees(";") else parse_expression(cursor))
    if cursor.sees("print", "printbold", "log"):
        return _parse_print(cursor)
    if cursor.accept("do"):
        body = _parse_statement(cursor)
        is_until = cursor.expect("while", "until").text == "until"
        return Loop(at, parse_parenthesized(cursor), body, is_until, test_first=False)
    if cursor.sees("++", "--"):
        operator = cursor.advance().text
        return Increment(at, operator, parse_target(cursor), is_prefix=True)
    if cursor.token.kind != "name" or cursor.token.text in KEYWORDS:
        raise cursor.unexpected("a statement")
    if cursor.is_call():
        return parse_call(cursor)
    assignments = cursor.comma_list(_parse_assignment)
    return assignments[0] if len(assignments) == 1 else Block(at, assignments)


def _parse_assignment(cursor: Cursor) -> Assign | Increment:
    target = parse_target(cursor)
    if cursor.sees("++", "--"):
        return Increment(target.at, cursor.advance().text, target, is_prefix=False)
    operator = cursor.expect(*ASSIGNMENTS, "++", "--").text
    return Assign(target.at, target, operator, parse_expression(cursor))


def _parse_block(cursor: Cursor) -> Block:
    at = cursor.expect("{").at
    statements: list[Statement] = []
    while not cursor.accept("}"):
        if cursor.token.kind == "end":
            raise cursor.unexpected("a statement or '}'")
        statements.append(_parse_statement(cursor))
    return Block(at, tuple(statements))


def _parse_if(cursor: Cursor, at: Position) -> If:
    branches = [(parse_parenthesized(cursor), _parse_statement(cursor))]
    while cursor.accept("else"):
        if not cursor.accept("if"):
            return If(at, tuple(branches), _parse_statement(cursor))
        branches.append((parse_parenthesized(cursor), _parse_statement(cursor)))
    return If(at, tuple(branches), None)


def _parse_for(cursor: Cursor, at: Position) -> For:
    cursor.expect("(")
    initial = _parse_statement(cursor)
    condition = parse_expression(cursor)
    cursor.expect(";")
    step = _parse_simple_statement(cursor)
    cursor.expect(")")
    return For(at, initial, condition, step, _parse_statement(cursor))


def _parse_switch(cursor: Cursor, at: Position) -> Switch:
    value = parse_parenthesized(cursor)
    cursor.expect("{")
    body: list[Statement | Case] = []
    while not cursor.accept("}"):
        label = cursor.token
        if cursor.accept("case"):
            body.append(Case(label.at, parse_expression(cursor)))
            cursor.expect(":")
        elif cursor.accept("default"):
            body.append(Case(label.at, None))
            cursor.expect(":")
        elif label.kind == "end":
            raise cursor.unexpected("'case', 'default', a statement or '}'")
        else:
            body.append(_parse_statement(cursor))
    return Switch(at, value, tuple(body))


def _parse_print(cursor: Cursor) -> Print:
    function = cursor.advance()
    cursor.expect("(")
    parts = cursor.comma_list(_parse_print_part)
    cursor.expect(")")
    return Print(function.at, function.text, parts)


def _parse_print_part(cursor: Cursor) -> tuple[str, Expression]:
    letter = cursor.expect("s", "d", "i", "c", "f").text
    cursor.expect(":")
    return letter, parse_expression(cursor)
