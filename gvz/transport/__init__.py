"""Tier 0. The communication between actors and learner: shared memory and control messages."""
