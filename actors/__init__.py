"""The acting side: processes that play ViZDoom and stream step records. May import gvz tiers 0 and 1."""
