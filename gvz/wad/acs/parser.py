"""Tokens to the syntax trees of declarations and statements. Checks the grammar of ACS, but not the names."""

from gvz.wad.acs import syntax
from gvz.wad.acs.cursor import KEYWORDS, SCRIPT_TYPES, TYPES, Cursor
from gvz.wad.acs.expression_parser import parse_call, parse_expression, parse_parenthesized, parse_target
from gvz.wad.acs.lexer import Position, error, tokenize

ASSIGNMENTS = ("=", "+=", "-=", "*=", "/=", "%=")


def parse(source: str) -> list[syntax.Declaration]:
    """Reads ACS source text; an error says what stands there and what could."""
    cursor = Cursor(tokenize(source))
    declarations: list[syntax.Declaration] = []
    while cursor.token.kind != "end":
        declaration = _parse_declaration(cursor)
        if declaration is not None:
            declarations.append(declaration)
    return declarations


# Declarations


def _parse_declaration(cursor: Cursor) -> syntax.Declaration | None:
    """Reads one declaration outside scripts and functions; None for an `#include`."""
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


def _parse_directive(cursor: Cursor, at: Position) -> syntax.Define | None:
    if cursor.accept("define"):
        name = cursor.identifier("constant")
        return syntax.Define(at, name.text, parse_expression(cursor))
    cursor.expect("include")
    file = cursor.advance()
    # The contents of zcommon.acs (built-ins, line specials, constants) are always known.
    if file.kind != "string" or file.text.lower() != "zcommon.acs":
        raise error(file.at, f'#include: got {file}, want "zcommon.acs"')
    return None


def _parse_global_variable(cursor: Cursor, at: Position) -> syntax.GlobalVariable:
    type_name = cursor.expect(*TYPES).text
    if cursor.token.kind != "number":
        raise cursor.unexpected("the number of a global variable")
    number = cursor.advance().value
    cursor.expect(":")
    name = cursor.identifier("global variable").text
    cursor.expect(";")
    return syntax.GlobalVariable(at, type_name, number, name)


def _parse_script(cursor: Cursor, at: Position) -> syntax.Script:
    if cursor.token.kind == "number":
        token = cursor.advance()
        number: syntax.Expression = syntax.Number(token.at, token.value, "." in token.text)
    else:
        token = cursor.identifier("script number's constant")
        number = syntax.Name(token.at, token.text)
    parameters: tuple[syntax.Parameter, ...] = ()
    if cursor.sees("("):
        parameters = _parse_parameters(cursor)
        event = cursor.accept("disconnect")
    else:
        event = cursor.expect("(", *SCRIPT_TYPES)
    return syntax.Script(at, number, event.text if event else "", parameters, _parse_statement(cursor))


def _parse_function(cursor: Cursor, at: Position) -> syntax.Function:
    returns = cursor.expect(*TYPES, "void").text
    name = cursor.identifier("function").text
    parameters = _parse_parameters(cursor)
    body = _parse_block(cursor)
    return syntax.Function(at, returns, name, parameters, body, end=cursor.last.at)


def _parse_parameters(cursor: Cursor) -> tuple[syntax.Parameter, ...]:
    cursor.expect("(")
    parameters = () if cursor.accept("void") else cursor.comma_list(_parse_parameter)
    cursor.expect(")")
    return parameters


def _parse_parameter(cursor: Cursor) -> syntax.Parameter:
    type_name = cursor.expect(*TYPES)
    return syntax.Parameter(type_name.at, type_name.text, cursor.identifier("parameter").text)


def _parse_declare(cursor: Cursor) -> syntax.Declare:
    type_name = cursor.expect(*TYPES)
    return syntax.Declare(type_name.at, cursor.comma_list(lambda cursor: _parse_variable(cursor, type_name.text)))


def _parse_variable(cursor: Cursor, type_name: str) -> syntax.Variable:
    name = cursor.identifier("variable")
    size, initial = None, None
    if cursor.accept("["):
        size = parse_expression(cursor)
        cursor.expect("]")
    if cursor.accept("="):
        initial = parse_expression(cursor) if size is None else _parse_array_values(cursor)
    return syntax.Variable(name.at, type_name, name.text, size, initial)


def _parse_array_values(cursor: Cursor) -> tuple[syntax.Expression, ...]:
    cursor.expect("{")
    values: list[syntax.Expression] = []
    while not cursor.sees("}"):
        values.append(parse_expression(cursor))
        if not cursor.accept(","):
            break
    cursor.expect("}")
    return tuple(values)


# Statements


def _parse_statement(cursor: Cursor) -> syntax.Statement:
    cursor.descend()
    statement = _parse_compound_statement(cursor)
    if statement is None:
        statement = _parse_simple_statement(cursor)
        cursor.expect(";")
    cursor.ascend()
    return statement


def _parse_compound_statement(cursor: Cursor) -> syntax.Statement | None:
    """Reads a statement that needs no ';'; None if the next statement is of another kind."""
    at = cursor.at
    if cursor.sees("{"):
        return _parse_block(cursor)
    if cursor.accept(";"):
        return syntax.Block(at, ())
    if cursor.accept("if"):
        return _parse_if(cursor, at)
    if cursor.sees("while", "until"):
        is_until = cursor.advance().text == "until"
        return syntax.Loop(at, parse_parenthesized(cursor), _parse_statement(cursor), is_until, test_first=True)
    if cursor.accept("for"):
        return _parse_for(cursor, at)
    if cursor.accept("switch"):
        return _parse_switch(cursor, at)
    return None


def _parse_simple_statement(cursor: Cursor) -> syntax.Statement:
    """Reads a statement that ends with ';' (or, as the step of a `for`, with ')')."""
    at = cursor.at
    if cursor.sees(*TYPES):
        return _parse_declare(cursor)
    if cursor.sees("break", "continue", "terminate", "suspend", "restart"):
        return syntax.Jump(at, cursor.advance().text)
    if cursor.accept("return"):
        return syntax.Return(at, None if cursor.sees(";") else parse_expression(cursor))
    if cursor.sees("print", "printbold", "log"):
        return _parse_print(cursor)
    if cursor.accept("do"):
        body = _parse_statement(cursor)
        is_until = cursor.expect("while", "until").text == "until"
        return syntax.Loop(at, parse_parenthesized(cursor), body, is_until, test_first=False)
    if cursor.sees("++", "--"):
        operator = cursor.advance().text
        return syntax.Increment(at, operator, parse_target(cursor), is_prefix=True)
    if cursor.token.kind != "name" or cursor.token.text in KEYWORDS:
        raise cursor.unexpected("a statement")
    if cursor.is_call():
        return parse_call(cursor)
    assignments = cursor.comma_list(_parse_assignment)
    return assignments[0] if len(assignments) == 1 else syntax.Block(at, assignments)


def _parse_assignment(cursor: Cursor) -> syntax.Assign | syntax.Increment:
    target = parse_target(cursor)
    if cursor.sees("++", "--"):
        return syntax.Increment(target.at, cursor.advance().text, target, is_prefix=False)
    operator = cursor.expect(*ASSIGNMENTS, "++", "--").text
    return syntax.Assign(target.at, target, operator, parse_expression(cursor))


def _parse_block(cursor: Cursor) -> syntax.Block:
    at = cursor.expect("{").at
    statements: list[syntax.Statement] = []
    while not cursor.accept("}"):
        if cursor.token.kind == "end":
            raise cursor.unexpected("a statement or '}'")
        statements.append(_parse_statement(cursor))
    return syntax.Block(at, tuple(statements))


def _parse_if(cursor: Cursor, at: Position) -> syntax.If:
    branches = [(parse_parenthesized(cursor), _parse_statement(cursor))]
    while cursor.accept("else"):
        if not cursor.accept("if"):
            return syntax.If(at, tuple(branches), _parse_statement(cursor))
        branches.append((parse_parenthesized(cursor), _parse_statement(cursor)))
    return syntax.If(at, tuple(branches), None)


def _parse_for(cursor: Cursor, at: Position) -> syntax.For:
    cursor.expect("(")
    initial = _parse_statement(cursor)
    condition = parse_expression(cursor)
    cursor.expect(";")
    step = _parse_simple_statement(cursor)
    cursor.expect(")")
    return syntax.For(at, initial, condition, step, _parse_statement(cursor))


def _parse_switch(cursor: Cursor, at: Position) -> syntax.Switch:
    value = parse_parenthesized(cursor)
    cursor.expect("{")
    body: list[syntax.Statement | syntax.Case] = []
    while not cursor.accept("}"):
        label = cursor.token
        if cursor.accept("case"):
            body.append(syntax.Case(label.at, parse_expression(cursor)))
            cursor.expect(":")
        elif cursor.accept("default"):
            body.append(syntax.Case(label.at, None))
            cursor.expect(":")
        elif label.kind == "end":
            raise cursor.unexpected("'case', 'default', a statement or '}'")
        else:
            body.append(_parse_statement(cursor))
    return syntax.Switch(at, value, tuple(body))


def _parse_print(cursor: Cursor) -> syntax.Print:
    function = cursor.advance()
    cursor.expect("(")
    parts = cursor.comma_list(_parse_print_part)
    cursor.expect(")")
    return syntax.Print(function.at, function.text, parts)


def _parse_print_part(cursor: Cursor) -> tuple[str, syntax.Expression]:
    letter = cursor.expect("s", "d", "i", "c", "f").text
    cursor.expect(":")
    return letter, parse_expression(cursor)
