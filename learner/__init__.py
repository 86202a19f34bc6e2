"""Tier 2. The learning side: replay, losses, agents, the jitted update."""
