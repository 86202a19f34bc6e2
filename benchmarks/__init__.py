"""Whole-system benchmarks beside their peers: `python -m benchmarks --list`. See docs/PERFORMANCE.md."""
