"""Tier 0. Errors, configuration of environments, and what keeps processes, files and machines in order."""
