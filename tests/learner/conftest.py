"""What tests of losses and returns share."""

from types import ModuleType

import pytest


@pytest.fixture
def rlax() -> ModuleType:
    """An independent implementation; importing it touches names that jax has deprecated."""
    import rlax

    return rlax
