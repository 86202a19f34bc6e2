"""The learning side: replay, losses, agents, the jitted update. May import gvz tier 0 only."""
