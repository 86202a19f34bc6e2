"""Tier 3. Experiments as data: one file each, found by its name, that defines `EXPERIMENT`. `docs/EXPERIMENTS.md` adds
one.

`base` says what an experiment is, `scale` shrinks it, `plan` is the grid that was asked for, `inventory` what of it
stands on the disk, `jobs` and `schedule` run it, `costs` says what it takes.
"""
