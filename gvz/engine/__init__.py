"""Tier 1. One ViZDoom process: its start, its watch, its end, and the proof that a map loads."""
