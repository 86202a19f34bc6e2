"""Tokens to syntax trees, by recursive descent. Knows the grammar of ACS, but no name's meaning."""

from collections.abc import Callable
from typing import TypeVar

from gvz.wad.acs.lexer import Position, Token, error, tokenize
from gvz.wad.acs.syntax import (
    Assign,
    Binary,
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
    Name,
    Number,
    Parameter,
    Print,
    Return,
    Script,
    Statement,
    String,
    Switch,
    Unary,
    Variable,
)

MAX_NESTING = 64
"""statements and operands inside each other; keeps every recursion over a tree far from Python's limit"""

TYPES = ("int", "str", "bool")
SCRIPT_TYPES = ("open", "enter", "respawn", "death", "disconnect")
KEYWORDS = frozenset(
    (
        *TYPES,
        *SCRIPT_TYPES,
        *("void", "global", "script", "function", "if", "else", "while", "until", "do", "for", "switch"),
        *("case", "default", "break", "continue", "return", "terminate", "suspend", "restart"),
        *("print", "printbold", "log"),
    )
)
"""words that cannot name anything"""

ASSIGNMENTS = ("=", "+=", "-=", "*=", "/=", "%=")
PRECEDENCE = {
    operator: level
    for level, operators in enumerate(
        ("||", "&&", "|", "^", "&", "== !=", "< <= > >=", "<< >>", "+ -", "* / %"), start=1
    )
    for operator in operators.split()
}
"""binary operators, all left-associative; a higher level binds tighter"""

T = TypeVar("T")


def parse(source: str) -> list[Declaration]:
    """Reads ACS source text.

    Raises:
        AcsError: text that is not of the subset; says what stands there and what could.
    """
    parser = _Parser(tokenize(source))
    declarations: list[Declaration] = []
    while parser.token.kind != "end":
        declaration = parser.declaration()
        if declaration is not None:
            declarations.append(declaration)
    return declarations


class _Parser:
    """A cursor over the tokens; lives as long as one `parse`. Methods are named for what they read."""

    def __init__(self, tokens: list[Token]):
        self._tokens = tokens
        self._next = 0
        self._depth = 0

    # The cursor

    @property
    def token(self) -> Token:
        return self._tokens[self._next]

    def _advance(self) -> Token:
        token = self.token
        if token.kind != "end":
            self._next += 1
        return token

    def _is(self, *texts: str) -> bool:
        return self.token.kind in ("name", "symbol") and self.token.text in texts

    def _accept(self, *texts: str) -> Token | None:
        return self._advance() if self._is(*texts) else None

    def _expect(self, *texts: str) -> Token:
        if not self._is(*texts):
            raise self._unexpected(" or ".join(repr(text) for text in texts))
        return self._advance()

    def _unexpected(self, wanted: str) -> Exception:
        return error(self.token.at, f"got {self.token}, want {wanted}")

    def _identifier(self, what: str) -> Token:
        if self.token.kind != "name":
            raise self._unexpected(f"the name of a {what}")
        if self.token.text in KEYWORDS:
            raise error(self.token.at, f"got the keyword {self.token.text!r}, want the name of a {what}")
        return self._advance()

    def _comma_list(self, item: Callable[[], T]) -> tuple[T, ...]:
        items = [item()]
        while self._accept(","):
            items.append(item())
        return tuple(items)

    def _enter(self, at: Position) -> None:
        self._depth += 1
        if self._depth > MAX_NESTING:
            raise error(at, f"nested too deeply: got {self._depth} levels, want at most {MAX_NESTING}")

    # Declarations

    def declaration(self) -> Declaration | None:
        """One top-level declaration; None for an `#include`."""
        start = self.token
        if self._accept("#"):
            return self._directive(start.at)
        if self._accept("global"):
            return self._global_variable(start.at)
        if self._accept("script"):
            return self._script(start.at)
        if self._accept("function"):
            return self._function(start.at)
        if self._is(*TYPES):
            declare = self._declare()
            self._expect(";")
            return declare
        raise self._unexpected("'script', 'function', 'global', 'int', 'str', 'bool' or '#'")

    def _directive(self, at: Position) -> Define | None:
        if self._accept("define"):
            name = self._identifier("constant")
            return Define(at, name.text, self._expression())
        self._expect("include")
        file = self._advance()
        # The contents of zcommon.acs (built-ins, line specials, constants) are always known.
        if file.kind != "string" or file.text.lower() != "zcommon.acs":
            raise error(file.at, f'#include: got {file}, want "zcommon.acs"')
        return None

    def _global_variable(self, at: Position) -> GlobalVariable:
        type_name = self._expect(*TYPES).text
        if self.token.kind != "number":
            raise self._unexpected("the number of a global variable")
        number = self._advance().value
        self._expect(":")
        name = self._identifier("global variable").text
        self._expect(";")
        return GlobalVariable(at, type_name, number, name)

    def _script(self, at: Position) -> Script:
        if self.token.kind == "number":
            token = self._advance()
            number: Expression = Number(token.at, token.value, "." in token.text)
        else:
            token = self._identifier("script number's constant")
            number = Name(token.at, token.text)
        parameters: tuple[Parameter, ...] = ()
        if self._is("("):
            parameters = self._parameters()
            event = self._accept("disconnect")
        else:
            event = self._expect("(", *SCRIPT_TYPES)
        return Script(at, number, event.text if event else "", parameters, self._statement())

    def _function(self, at: Position) -> Function:
        returns = self._expect(*TYPES, "void").text
        name = self._identifier("function").text
        parameters = self._parameters()
        body = self._block()
        return Function(at, returns, name, parameters, body, self._tokens[self._next - 1].at)

    def _parameters(self) -> tuple[Parameter, ...]:
        self._expect("(")
        if self._accept("void"):
            self._expect(")")
            return ()
        parameters = self._comma_list(self._parameter)
        self._expect(")")
        return parameters

    def _parameter(self) -> Parameter:
        type_name = self._expect(*TYPES)
        return Parameter(type_name.at, type_name.text, self._identifier("parameter").text)

    def _declare(self) -> Declare:
        type_name = self._expect(*TYPES)
        return Declare(type_name.at, self._comma_list(lambda: self._variable(type_name.text)))

    def _variable(self, type_name: str) -> Variable:
        name = self._identifier("variable")
        size, initial = None, None
        if self._accept("["):
            size = self._expression()
            self._expect("]")
        if self._accept("="):
            initial = self._expression() if size is None else self._array_values()
        return Variable(name.at, type_name, name.text, size, initial)

    def _array_values(self) -> tuple[Expression, ...]:
        self._expect("{")
        values: list[Expression] = []
        while not self._is("}"):
            values.append(self._expression())
            if not self._accept(","):
                break
        self._expect("}")
        return tuple(values)

    # Statements

    def _statement(self) -> Statement:
        start = self.token
        self._enter(start.at)
        statement = self._compound_statement()
        if statement is None:
            statement = self._simple_statement()
            self._expect(";")
        self._depth -= 1
        return statement

    def _compound_statement(self) -> Statement | None:
        """A statement with a body, or an empty one; None where neither stands."""
        at = self.token.at
        if self._is("{"):
            return self._block()
        if self._accept(";"):
            return Block(at, ())
        if self._accept("if"):
            return self._if(at)
        if self._is("while", "until"):
            is_until = self._advance().text == "until"
            return Loop(at, self._condition(), self._statement(), is_until, test_first=True)
        if self._accept("for"):
            return self._for(at)
        if self._accept("switch"):
            return self._switch(at)
        return None

    def _simple_statement(self) -> Statement:
        """A statement that a ';' ends (or, as the step of a `for`, a ')')."""
        at = self.token.at
        if self._is(*TYPES):
            return self._declare()
        if self._is("break", "continue", "terminate", "suspend", "restart"):
            return Jump(at, self._advance().text)
        if self._accept("return"):
            return Return(at, None if self._is(";") else self._expression())
        if self._is("print", "printbold", "log"):
            return self._print()
        if self._accept("do"):
            body = self._statement()
            is_until = self._expect("while", "until").text == "until"
            return Loop(at, self._condition(), body, is_until, test_first=False)
        if self._is("++", "--"):
            operator = self._advance().text
            return Increment(at, operator, self._target(), is_prefix=True)
        if self.token.kind != "name" or self.token.text in KEYWORDS:
            raise self._unexpected("a statement")
        if self._tokens[self._next + 1].text == "(":
            return self._call(self._advance())
        assignments = self._comma_list(self._assignment)
        return assignments[0] if len(assignments) == 1 else Block(at, assignments)

    def _assignment(self) -> Assign | Increment:
        target = self._target()
        if self._is("++", "--"):
            return Increment(target.at, self._advance().text, target, is_prefix=False)
        operator = self._expect(*ASSIGNMENTS, "++", "--").text
        return Assign(target.at, target, operator, self._expression())

    def _block(self) -> Block:
        at = self._expect("{").at
        statements: list[Statement] = []
        while not self._accept("}"):
            if self.token.kind == "end":
                raise self._unexpected("a statement or '}'")
            statements.append(self._statement())
        return Block(at, tuple(statements))

    def _condition(self) -> Expression:
        self._expect("(")
        condition = self._expression()
        self._expect(")")
        return condition

    def _if(self, at: Position) -> If:
        branches = [(self._condition(), self._statement())]
        while self._accept("else"):
            if not self._accept("if"):
                return If(at, tuple(branches), self._statement())
            branches.append((self._condition(), self._statement()))
        return If(at, tuple(branches), None)

    def _for(self, at: Position) -> For:
        self._expect("(")
        initial = self._statement()
        condition = self._expression()
        self._expect(";")
        step = self._simple_statement()
        self._expect(")")
        return For(at, initial, condition, step, self._statement())

    def _switch(self, at: Position) -> Switch:
        value = self._condition()
        self._expect("{")
        body: list[Statement | Case] = []
        while not self._accept("}"):
            label = self.token
            if self._accept("case"):
                body.append(Case(label.at, self._expression()))
                self._expect(":")
            elif self._accept("default"):
                body.append(Case(label.at, None))
                self._expect(":")
            elif label.kind == "end":
                raise self._unexpected("'case', 'default', a statement or '}'")
            else:
                body.append(self._statement())
        return Switch(at, value, tuple(body))

    def _print(self) -> Print:
        function = self._advance()
        self._expect("(")
        parts = self._comma_list(self._print_part)
        self._expect(")")
        return Print(function.at, function.text, parts)

    def _print_part(self) -> tuple[str, Expression]:
        letter = self._expect("s", "d", "i", "c", "f").text
        self._expect(":")
        return letter, self._expression()

    # Expressions

    def _expression(self, lowest: int = 1) -> Expression:
        """Binary operators of level `lowest` and above, by precedence climbing."""
        self._enter(self.token.at)
        left = self._unary()
        while self.token.kind == "symbol" and PRECEDENCE.get(self.token.text, 0) >= lowest:
            operator = self._advance()
            right = self._expression(PRECEDENCE[operator.text] + 1)
            left = Binary(operator.at, operator.text, left, right)
        self._depth -= 1
        return left

    def _unary(self) -> Expression:
        start = self.token
        if self._accept("++", "--"):
            return Increment(start.at, start.text, self._target(), is_prefix=True)
        if not self._accept("-", "+", "!", "~"):
            return self._primary()
        self._enter(start.at)
        operand = self._unary()
        self._depth -= 1
        return operand if start.text == "+" else Unary(start.at, start.text, operand)

    def _primary(self) -> Expression:
        token = self.token
        if token.kind == "number":
            return Number(token.at, self._advance().value, "." in token.text)
        if token.kind == "string":
            return String(token.at, self._advance().text)
        if self._accept("("):
            inner = self._expression()
            self._expect(")")
            return inner
        if token.kind != "name" or token.text in KEYWORDS:
            raise self._unexpected("an expression")
        if self._tokens[self._next + 1].text == "(":
            return self._call(self._advance())
        target = self._target()
        if self._is("++", "--"):
            return Increment(target.at, self._advance().text, target, is_prefix=False)
        return target

    def _call(self, name: Token) -> Call:
        self._expect("(")
        arguments = () if self._is(")") else self._comma_list(self._expression)
        self._expect(")")
        return Call(name.at, name.text, arguments)

    def _target(self) -> Name:
        name = self._identifier("variable")
        if not self._accept("["):
            return Name(name.at, name.text)
        index = self._expression()
        self._expect("]")
        return Name(name.at, name.text, index)
