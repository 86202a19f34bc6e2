"""Tier 3. A training run: its configuration, its loop, its records, its checkpoints."""
