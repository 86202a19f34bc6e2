"""Tier 0. All that actors and learner say to each other."""
