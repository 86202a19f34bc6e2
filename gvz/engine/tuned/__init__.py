"""ViZDoom with our changes for speed: patches, and what builds a wheel with them (docs/ENGINE.md).

Nothing here is needed to play.
"""

TUNED = "+gvz."
"""begins the local part of the tuned engine's version, such as 1.3.2+gvz.1"""


def describe_engine(version: str) -> str:
    """Which ViZDoom a version is: "1.3.2, as released" or "1.3.2+gvz.1, tuned"."""
    return f"{version}, {'tuned' if TUNED in version else 'as released'}"
