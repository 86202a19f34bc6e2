"""Tier 1. File formats of the Doom engine: WAD lumps, UDMF map text, ACS scripts, DECORATE names. No game logic."""
