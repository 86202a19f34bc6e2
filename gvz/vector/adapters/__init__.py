"""`gvz.make_vec` as other libraries want a vector environment: one module a library, imported by whoever has it."""
