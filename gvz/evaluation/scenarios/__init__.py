"""Tier 3. What simple players and pictures need of each scenario: a file each, named as in `gvz/scenarios/`.

A file may define `SWEEP` and `script` (how to play the scenario without training), `MOMENTS` and `MOVING` (what
pictures show); `gvz.evaluation.scenarios.base` says what they are. A scenario without a file has no sweep and no
script, and its pictures show how an episode starts.
"""
