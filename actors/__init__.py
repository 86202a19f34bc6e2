"""Tier 2. The acting side: processes that play ViZDoom and stream step records."""
