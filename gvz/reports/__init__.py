"""Tier 3. Pictures and tables made of a run's records, never of its checkpoints."""
