"""GViZDoom: graded visual generalization in Doom, and a trainer for it."""

__version__ = "0.1.0"
