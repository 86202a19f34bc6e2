"""UDMF, the map format: TEXTMAP text to lists of blocks and back.

The engine ends the process if a block of a map refers to a missing block. So references and required fields are checked
when a map is read and again when it is written.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NoReturn

from gvz.core.errors import WadError

Value = bool | int | float | str
Block = dict[str, Value]
"""the fields of one vertex, linedef, ...; names are lower case"""

MAX_COORDINATE = 32767
"""map units; the engine's coordinates are 16.16 fixed point"""
MAX_NUMBER_LENGTH = 40
"""characters of a number; a longer number is damaged"""

REFERENCES = (
    # kind, field, kind of the block it refers to, required
    ("linedef", "v1", "vertex", True),
    ("linedef", "v2", "vertex", True),
    ("linedef", "sidefront", "sidedef", True),
    ("linedef", "sideback", "sidedef", False),
    ("sidedef", "sector", "sector", True),
)
NO_REFERENCE = -1
"""value of an optional reference that is not used, as editors write it"""
REQUIRED: tuple[tuple[str, str, type], ...] = (
    ("vertex", "x", float),
    ("vertex", "y", float),
    ("sector", "texturefloor", str),
    ("sector", "textureceiling", str),
    ("thing", "x", float),
    ("thing", "y", float),
    ("thing", "type", int),
)

_PATTERN = re.compile(
    r"""(?P<blank>[\x00-\x20]+|//[^\n]*|/\*.*?\*/)
    |(?P<name>[A-Za-z_][A-Za-z0-9_]*)
    |(?P<float>[+-]?[0-9]+\.[0-9]*(?:[eE][+-]?[0-9]+)?)
    |(?P<int>[+-]?(?:0[xX][0-9A-Fa-f]+|[1-9][0-9]*|0(?![0-9])))
    |(?P<string>"(?:[^"\\\n]|\\[^\n])*")
    |(?P<symbol>[{}=;])
    """,
    re.VERBOSE | re.DOTALL,
)
_TOKEN_KINDS = ("name", "float", "int", "string", "symbol")
_FIELD = re.compile(r"[a-z_][a-z0-9_]*")
_STRING = re.compile(r"[\x20-\x7e\xa0-\xff]*")


@dataclass(slots=True)
class UdmfMap:
    """A map. A block's number is its place in its list; linedefs refer to vertices and sidedefs by this number."""

    namespace: str = "zdoom"
    things: list[Block] = field(default_factory=list)
    vertices: list[Block] = field(default_factory=list)
    linedefs: list[Block] = field(default_factory=list)
    sidedefs: list[Block] = field(default_factory=list)
    sectors: list[Block] = field(default_factory=list)

    def blocks(self) -> dict[str, list[Block]]:
        """The lists by UDMF's name of their blocks, in the order in which they are written."""
        return {
            "thing": self.things,
            "vertex": self.vertices,
            "linedef": self.linedefs,
            "sidedef": self.sidedefs,
            "sector": self.sectors,
        }

    def copy(self) -> "UdmfMap":
        """A map that can be changed without changing this one."""
        lists = ([dict(block) for block in blocks] for blocks in self.blocks().values())
        return UdmfMap(self.namespace, *lists)


def make_thing(type_number: int, x: float, y: float, *, tid: int = 0, angle: int = 0) -> Block:
    """A thing that exists at every skill level and in every game mode.

    Args:
        type_number: editor number of its actor class.
        x, y: place, map units.
        tid: number by which scripts refer to it; 0 for none.
        angle: degrees, 0 is east, 90 north.
    """
    present = ("skill1", "skill2", "skill3", "skill4", "skill5", "single", "coop", "dm")
    identity: Block = {"id": tid} if tid else {}
    return {
        **identity,
        "x": float(x),
        "y": float(y),
        "angle": angle,
        "type": type_number,
        **dict.fromkeys(present, True),
    }


def is_inside(udmf_map: UdmfMap, x: float, y: float) -> bool:
    """Whether a place, in map units, is in a sector: a ray from there eastwards meets an odd number of walls."""
    num_walls = 0
    for line in udmf_map.linedefs:
        if line.get("sideback", NO_REFERENCE) != NO_REFERENCE:
            continue  # open space on both sides
        (x1, y1), (x2, y2) = (
            (float(vertex["x"]), float(vertex["y"]))
            for vertex in (udmf_map.vertices[int(line[end])] for end in ("v1", "v2"))
        )
        if (y1 > y) != (y2 > y) and x < x1 + (y - y1) / (y2 - y1) * (x2 - x1):
            num_walls += 1
    return num_walls % 2 == 1


def parse_textmap(text: str) -> UdmfMap:
    """Reads the text of a TEXTMAP lump.

    Raises:
        WadError: it is not UDMF, or a block lacks a required field or refers to a missing block.
    """
    return _Parser(text).parse()


@dataclass(frozen=True, slots=True)
class _Token:
    kind: str
    text: str
    line: int

    def __str__(self) -> str:
        return "the end of the text" if self.kind == "end" else repr(self.text)


def _tokens(text: str) -> Iterator[_Token]:
    offset, line = 0, 1
    while offset < len(text):
        match = _PATTERN.match(text, offset)
        if match is None or (match.group() == "/" and text.startswith("/*", offset)):
            _fail(line, f"got {text[offset : offset + 10]!r}", "a name, number, string, '{', '}', '=' or ';'")
        if match.lastgroup in _TOKEN_KINDS:
            yield _Token(match.lastgroup, match.group(), line)
        line += match.group().count("\n")
        offset = match.end()
    yield _Token("end", "", line)


def _fail(line: int, got: str, want: str) -> NoReturn:
    raise WadError(f"TEXTMAP line {line}: {got}, want {want}")


class _Parser:
    """Reads one text, token by token."""

    def __init__(self, text: str):
        self._tokens = _tokens(text)
        self._token = next(self._tokens)

    def parse(self) -> UdmfMap:
        result = UdmfMap(namespace="")
        blocks = result.blocks()
        lines: dict[str, list[int]] = {kind: [] for kind in blocks}
        while self._token.kind != "end":
            name = self._expect_name("a block or 'namespace'")
            kind = name.text.lower()
            if self._token.text == "=":
                value = self._value_of_field()
                if kind != "namespace" or not isinstance(value, str) or result.namespace:
                    _fail(name.line, f"got the assignment of {name.text!r}", "'namespace = \"...\";' once, or a block")
                result.namespace = value
            elif kind in blocks:
                lines[kind].append(name.line)
                blocks[kind].append(self._block())
            else:
                _fail(name.line, f"got the block {name.text!r}", f"one of {', '.join(blocks)}")
        if not result.namespace:
            _fail(1, "got no namespace", "'namespace = \"zdoom\";'")
        _check(result, lines)
        return result

    def _block(self) -> Block:
        fields: Block = {}
        self._expect_symbol("{")
        while self._token.text != "}" or self._token.kind != "symbol":
            name = self._expect_name("a field or '}'")
            if name.text.lower() in fields:
                _fail(name.line, f"got the field {name.text!r} again", "it once in a block")
            fields[name.text.lower()] = self._value_of_field()
        self._advance()
        return fields

    def _value_of_field(self) -> Value:
        self._expect_symbol("=")
        value = self._value(self._advance())
        self._expect_symbol(";")
        return value

    def _value(self, token: _Token) -> Value:
        if token.kind in ("int", "float") and len(token.text) > MAX_NUMBER_LENGTH:
            _fail(token.line, f"got a number of {len(token.text)} characters", f"at most {MAX_NUMBER_LENGTH}")
        match token.kind:
            case "int":
                value = int(token.text, 0)
                if not -(2**31) <= value < 2**31:
                    _fail(token.line, f"got the number {token.text}", "a 32-bit one")
                return value
            case "float":
                number = float(token.text)
                if abs(number) == float("inf"):
                    _fail(token.line, f"got the number {token.text}", "a finite one")
                return number
            case "string":
                return re.sub(r"\\(.)", r"\1", token.text[1:-1])
            case "name" if token.text.lower() in ("true", "false"):
                return token.text.lower() == "true"
            case _:
                _fail(token.line, f"got {token}", "a number, a string, true or false")

    def _advance(self) -> _Token:
        token = self._token
        if token.kind != "end":
            self._token = next(self._tokens)
        return token

    def _expect_name(self, wanted: str) -> _Token:
        if self._token.kind != "name":
            _fail(self._token.line, f"got {self._token}", wanted)
        return self._advance()

    def _expect_symbol(self, text: str) -> None:
        if self._token.kind != "symbol" or self._token.text != text:
            _fail(self._token.line, f"got {self._token}", repr(text))
        self._advance()


def write_textmap(udmf_map: UdmfMap) -> str:
    """Writes a map as the text of a TEXTMAP lump; equal maps give equal text.

    Raises:
        WadError: a block lacks a required field, refers to a missing block, or holds a value that UDMF cannot express.
    """
    _check(udmf_map, {})
    parts = [f"namespace = {_write_value(udmf_map.namespace, 'namespace')};\n"]
    for kind, blocks in udmf_map.blocks().items():
        for number, block in enumerate(blocks):
            fields = "".join([f"{name} = {_write_value(block[name], kind, number, name)};\n" for name in block])
            parts.append(f"\n{kind} // {number}\n{{\n{fields}}}\n")
    return "".join(parts)


def _write_value(value: Value, kind: str, number: int = 0, name: str = "") -> str:
    of = type(value)  # maps are drawn and written between episodes: this is three times as quick as patterns
    if of is bool:
        return "true" if value else "false"
    if of is float and -math.inf < value < math.inf:  # pyright: ignore[reportOperatorIssue]
        # The shortest digits that give the same number. Python writes 1e-05 without a point; UDMF needs the point.
        digits, exponent_mark, exponent = repr(value).partition("e")
        return (digits if "." in digits else digits + ".0") + exponent_mark + exponent
    if of is int and -(2**31) <= value < 2**31:  # pyright: ignore[reportOperatorIssue]
        return str(value)
    if isinstance(value, str) and _STRING.fullmatch(value):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    place = f"{kind} {number}: {name}" if name else kind
    raise WadError(f"{place}: got {value!r}, want a boolean, 32-bit integer, finite float or Latin-1 text")


def _check(udmf_map: UdmfMap, lines: Mapping[str, Sequence[int]]) -> None:
    """Refuses maps on which the engine would fail. `lines` are the line numbers of blocks, if a text was read."""
    all_blocks = udmf_map.blocks()
    counts = {kind: len(blocks) for kind, blocks in all_blocks.items()}
    for kind, blocks in all_blocks.items():
        for number, block in enumerate(blocks):
            line = f"TEXTMAP line {lines[kind][number]}, " if kind in lines else ""
            _check_block(f"{line}{kind} {number}", kind, block, counts)


def _check_block(where: str, kind: str, block: Block, counts: Mapping[str, int]) -> None:
    for name in block:
        if not _FIELD.fullmatch(name):
            raise WadError(f"{where}: got the field {name!r}, want a lower-case name")
    for owner, name, wanted in REQUIRED:
        if owner == kind:
            _check_required(f"{where}, {name}", block.get(name), wanted)
    for owner, name, target, is_required in REFERENCES:
        if owner != kind:
            continue
        value = block.get(name, NO_REFERENCE)
        if value == NO_REFERENCE and not is_required:
            continue
        if type(value) is not int or not 0 <= value < counts[target]:
            got = repr(block[name]) if name in block else "nothing"
            raise WadError(f"{where}, {name}: got {got}, want the number of one of {counts[target]} {target} blocks")


def _check_required(where: str, value: Value | None, wanted: type) -> None:
    if wanted is float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_COORDINATE:
            raise WadError(f"{where}: got {value!r}, want a coordinate from -{MAX_COORDINATE} to {MAX_COORDINATE}")
    elif type(value) is not wanted:
        raise WadError(f"{where}: got {value!r}, want {wanted.__name__}")
