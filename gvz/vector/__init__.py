"""Many games as one Gymnasium vector environment, played by worker processes.

Tier 1. `env.py` is what a user holds. `crew.py` starts and watches the workers, `worker.py` is one of them.
"""
