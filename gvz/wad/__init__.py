"""File formats of the Doom engine: WAD lumps, UDMF map text, ACS scripts, DECORATE names. No game logic.

May import `gvz.errors`, numpy and the standard library; never vizdoom's compiled module, never jax.
"""
