"""Tier 3. Evaluation: playing episodes with a trained, random or idle agent, and what to make of their scores."""
