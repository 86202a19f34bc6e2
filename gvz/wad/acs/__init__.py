"""ACS source text to BEHAVIOR bytecode, byte for byte the hybrid object file that ACC writes.

lexer -> parser (syntax trees) -> codegen (checks, instructions) -> behavior (object file). `compile_acs` is the
whole public interface.
"""

from gvz.wad.acs.codegen import compile_acs

__all__ = ["compile_acs"]
