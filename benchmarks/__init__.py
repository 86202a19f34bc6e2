"""What is measured for the pages: throughput beside peers (`python -m benchmarks --list`), reference scores, contrast,
reliability; and a probe of encoders and augmentations.
"""
