"""Tier 3. Run configurations: each file defines `CONFIG`. A bare name given to `--config` is found here."""
