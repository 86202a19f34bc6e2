"""Instructions to bytes, in ACS's compact encoding."""

import struct

PUSH_NUMBER, PUSH_BYTE, PUSH_BYTES, PUSH_2_BYTES = 3, 167, 175, 176
CASE_GOTO_SORTED = 256
MAX_RUN = 255
"""constants that one PUSH_BYTES can hold"""


class Label:
    """A target of jumps, whose address may still be unknown when a jump is emitted."""

    def __init__(self) -> None:
        self.address: int | None = None


class Assembler:
    """The code of one object file during its compilation.

    Consecutive pushes of constants from 0 to 255 become one instruction, so they are kept until another instruction
    follows.
    """

    def __init__(self) -> None:
        self._code = bytearray(8)  # the file's header, filled in when the file is laid out
        self._run: list[int] = []
        self._jumps: list[tuple[int, Label]] = []
        self.last_opcode = 0
        """opcode of the last instruction; 0 if the next instruction can be the target of a jump"""

    @property
    def address(self) -> int:
        """File address of the next instruction."""
        self._flush()
        return len(self._code)

    def emit(self, opcode: int, *operands: int) -> None:
        """Appends an instruction with one-byte operands."""
        self._flush()
        self._append(opcode)
        self._code += bytes(operands)

    def emit_call(self, opcode: int, num_arguments: int, number: int) -> None:
        """Appends a call of one of the engine's numbered functions."""
        self.emit(opcode, num_arguments, number & 255, number >> 8)

    def push(self, value: int) -> None:
        """Appends the push of a 32-bit constant."""
        value &= 0xFFFFFFFF
        if value <= 255 and len(self._run) < MAX_RUN:
            self._run.append(value)
            return
        self._flush()
        if value <= 255:
            self._run.append(value)
        else:
            self._append(PUSH_NUMBER)
            self._code += struct.pack("<I", value)

    def jump(self, opcode: int, target: Label) -> None:
        """Appends a jump."""
        self.emit(opcode)
        self._reference(target)

    def jump_by_case(self, cases: list[tuple[int, Label]]) -> None:
        """Appends the jump table of a switch; `cases` must be sorted by value."""
        self.emit(CASE_GOTO_SORTED)
        self._code += bytes(-len(self._code) % 4)
        self._code += struct.pack("<I", len(cases))
        for value, target in cases:
            self._code += struct.pack("<i", value)
            self._reference(target)

    def begin_body(self) -> None:
        """Begins a body: its first instruction has no instruction before it."""
        self.last_opcode = 0

    def place(self, label: Label) -> None:
        """Sets the address of `label` to the next instruction."""
        label.address = self.address
        self.last_opcode = 0

    def finish(self) -> bytes:
        """The complete code with the header's space and all jump addresses."""
        self._flush()
        for position, label in self._jumps:
            assert label.address is not None
            struct.pack_into("<I", self._code, position, label.address)
        return bytes(self._code)

    def _reference(self, label: Label) -> None:
        self._jumps.append((len(self._code), label))
        self._code += bytes(4)

    def _append(self, opcode: int) -> None:
        if opcode < 240:
            self._code.append(opcode)
        else:  # the top 16 byte values select a page of opcodes
            self._code += bytes((240 + ((opcode - 240) >> 8), (opcode - 240) & 255))
        self.last_opcode = opcode

    def _flush(self) -> None:
        run, self._run = self._run, []
        if not run:
            return
        if len(run) == 1:
            self._append(PUSH_BYTE)
        elif len(run) <= 5:
            self._append(PUSH_2_BYTES + len(run) - 2)
        else:
            self._append(PUSH_BYTES)
            self._code.append(len(run))
        self._code += bytes(run)
