"""Tokens to the syntax trees of expressions."""

from gvz.wad.acs.cursor import KEYWORDS, Cursor
from gvz.wad.acs.syntax import Binary, Call, Expression, Increment, Name, Number, String, Unary

PRECEDENCE = {
    operator: level
    for level, operators in enumerate(
        ("||", "&&", "|", "^", "&", "== !=", "< <= > >=", "<< >>", "+ -", "* / %"), start=1
    )
    for operator in operators.split()
}
"""binary operators, all left-associative; a higher level binds tighter"""


def parse_expression(cursor: Cursor, lowest: int = 1) -> Expression:
    """Reads an expression whose binary operators are of level `lowest` and above, by precedence climbing."""
    cursor.descend()
    left = _parse_unary(cursor)
    while cursor.token.kind == "symbol" and PRECEDENCE.get(cursor.token.text, 0) >= lowest:
        operator = cursor.advance()
        right = parse_expression(cursor, PRECEDENCE[operator.text] + 1)
        left = Binary(operator.at, operator.text, left, right)
    cursor.ascend()
    return left


def _parse_unary(cursor: Cursor) -> Expression:
    start = cursor.token
    if cursor.accept("++", "--"):
        return Increment(start.at, start.text, parse_target(cursor), is_prefix=True)
    if not cursor.accept("-", "+", "!", "~"):
        return _parse_primary(cursor)
    cursor.descend()
    operand = _parse_unary(cursor)
    cursor.ascend()
    return operand if start.text == "+" else Unary(start.at, start.text, operand)


def _parse_primary(cursor: Cursor) -> Expression:
    token = cursor.token
    if token.kind == "number":
        return Number(token.at, cursor.advance().value, "." in token.text)
    if token.kind == "string":
        return String(token.at, cursor.advance().text)
    if cursor.sees("("):
        return parse_parenthesized(cursor)
    if token.kind != "name" or token.text in KEYWORDS:
        raise cursor.unexpected("an expression")
    if cursor.is_call():
        return parse_call(cursor)
    target = parse_target(cursor)
    if cursor.sees("++", "--"):
        return Increment(target.at, cursor.advance().text, target, is_prefix=False)
    return target


def parse_parenthesized(cursor: Cursor) -> Expression:
    """Reads an expression in parentheses."""
    cursor.expect("(")
    inner = parse_expression(cursor)
    cursor.expect(")")
    return inner


def parse_call(cursor: Cursor) -> Call:
    """Reads a name and its arguments."""
    name = cursor.advance()
    cursor.expect("(")
    arguments = () if cursor.sees(")") else cursor.comma_list(parse_expression)
    cursor.expect(")")
    return Call(name.at, name.text, arguments)


def parse_target(cursor: Cursor) -> Name:
    """Reads the name of a variable or constant, or an element of an array."""
    name = cursor.identifier("variable")
    if not cursor.accept("["):
        return Name(name.at, name.text)
    index = parse_expression(cursor)
    cursor.expect("]")
    return Name(name.at, name.text, index)
