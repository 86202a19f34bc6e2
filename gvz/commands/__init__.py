"""Tier 3. The commands of `gvz`, one file each: a dataclass of its flags, named by `COMMAND`, with `run() -> exit
code`.
"""
