"""The compiled object file: the layout of a BEHAVIOR lump in ACC's hybrid format.

Hybrid means: for old tools the file has no strings and its scripts do nothing; the engine finds the real tables as
chunks before the old directory.
"""

import struct
from dataclasses import dataclass

MAX_PLAIN_LOCALS = 20
"""locals of a script that needs no SVCT entry"""


@dataclass(frozen=True, slots=True)
class ScriptEntry:
    """A compiled script. `num_locals` includes its parameters; `array_sizes` are the sizes of its local arrays."""

    number: int
    type: int
    address: int
    num_parameters: int
    num_locals: int
    array_sizes: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class FunctionEntry:
    """A compiled function. `num_locals` does not include its parameters."""

    name: str
    returns: bool
    address: int
    num_parameters: int
    num_locals: int
    array_sizes: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class MapVariableEntry:
    """A variable of the map: its initial value, or the initial values of an array (`size` > 0)."""

    size: int
    values: tuple[int, ...]


def write_behavior(
    code: bytes,
    scripts: list[ScriptEntry],
    functions: list[FunctionEntry],
    strings: list[bytes],
    variables: list[MapVariableEntry],
) -> bytes:
    """Lays out a BEHAVIOR lump. `code` starts with the 8-byte header, so that its offsets are file addresses."""
    out = bytearray(code)
    out += bytes(-len(out) % 4)
    # One do-nothing script per script number that the old directory can name.
    visible = [script for script in scripts if script.number <= 255]
    dummies = len(out)
    out += struct.pack("<I", 1) * len(visible)

    chunks = len(out)
    _append_script_chunks(out, scripts)
    if functions:
        _append_function_chunks(out, functions)
    if strings:
        _append_string_chunk(out, b"STRL", strings, has_zeros=True)
    _append_variable_chunks(out, variables)
    out += struct.pack("<I4s", chunks, b"ACSe")

    struct.pack_into("<4sI", out, 0, b"ACS\0", len(out))
    out += struct.pack("<I", len(visible))
    for i, script in enumerate(visible):
        out += struct.pack("<III", script.number, dummies + 4 * i, script.num_parameters)
    return bytes(out + struct.pack("<I", 0))


def _append_chunk(out: bytearray, name: bytes, data: bytes) -> None:
    out += struct.pack("<4sI", name, len(data)) + data


def _append_script_chunks(out: bytearray, scripts: list[ScriptEntry]) -> None:
    if scripts:
        entries = (struct.pack("<hBBI", s.number, s.type, s.num_parameters, s.address) for s in scripts)
        _append_chunk(out, b"SPTR", b"".join(entries))
    large = [s for s in scripts if s.num_locals > MAX_PLAIN_LOCALS]
    if large:
        _append_chunk(out, b"SVCT", b"".join(struct.pack("<hH", s.number, s.num_locals) for s in large))
    for script in scripts:
        _append_array_chunk(out, b"SARY", script.number, script.array_sizes)


def _append_function_chunks(out: bytearray, functions: list[FunctionEntry]) -> None:
    entries = (struct.pack("<BBBBI", f.num_parameters, f.num_locals, f.returns, 0, f.address) for f in functions)
    _append_chunk(out, b"FUNC", b"".join(entries))
    _append_string_chunk(out, b"FNAM", [f.name.encode("ascii") for f in functions], has_zeros=False)
    for number, function in enumerate(functions):
        _append_array_chunk(out, b"FARY", number, function.array_sizes)


def _append_array_chunk(out: bytearray, name: bytes, owner: int, sizes: tuple[int, ...]) -> None:
    if sizes:
        _append_chunk(out, name, struct.pack(f"<h{len(sizes)}I", owner, *sizes))


def _append_string_chunk(out: bytearray, name: bytes, strings: list[bytes], *, has_zeros: bool) -> None:
    """Count (in STRL between zeros), offsets from the chunk's data on, zero-ended strings."""
    head = struct.pack("<III", 0, len(strings), 0) if has_zeros else struct.pack("<I", len(strings))
    offset = len(head) + 4 * len(strings)
    offsets = bytearray()
    for string in strings:
        offsets += struct.pack("<I", offset)
        offset += len(string) + 1
    data = head + offsets + b"".join(string + b"\0" for string in strings)
    # The next chunk starts at a file address divisible by 4; after an array chunk this is not the end of its data.
    data += bytes(-(len(out) + 8 + len(data)) % 4)
    _append_chunk(out, name, data)


def _append_variable_chunks(out: bytearray, variables: list[MapVariableEntry]) -> None:
    starts = [0 if v.size else v.values[0] for v in variables]
    used = [i for i, start in enumerate(starts) if start]
    if used:
        first, last = used[0], used[-1]
        values = starts[first : last + 1]
        _append_chunk(out, b"MINI", struct.pack(f"<I{len(values)}I", first, *values))
    arrays = [(i, v) for i, v in enumerate(variables) if v.size]
    if arrays:
        _append_chunk(out, b"ARAY", b"".join(struct.pack("<II", i, v.size) for i, v in arrays))
    for i, array in arrays:
        num_values = max((j + 1 for j, value in enumerate(array.values) if value), default=0)
        if num_values:
            _append_chunk(out, b"AINI", struct.pack(f"<I{num_values}I", i, *array.values[:num_values]))
