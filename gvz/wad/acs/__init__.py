"""Compiles ACS source text to BEHAVIOR bytecode, byte for byte the hybrid object file that ACC writes.

lexer -> parser (syntax trees) -> codegen (checks, instructions) -> behavior (object file). `compile_acs` is the only
public name. Where a function of these modules finds something else than its docstring says, it raises an AcsError with
the place in the source.
"""

from gvz.wad.acs.codegen import compile_acs

__all__ = ["compile_acs"]
