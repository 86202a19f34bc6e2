"""The check of a field's type."""

from typing import Any, Literal

import pytest

from gvz.core.env_config import typed
from gvz.core.errors import ConfigError


@pytest.mark.parametrize("value", [3, "a", None])
@pytest.mark.parametrize("kind", [str | int | None, Literal["a"] | int | None])
def test_a_field_may_have_several_types_and_none(kind: Any, value: Any):
    assert typed(kind, value, "x") == value


@pytest.mark.parametrize("value", [1.5, True])
def test_a_value_of_none_of_several_types_is_refused(value: Any):
    with pytest.raises(ConfigError, match=rf"x: got {value}, want .*int"):
        typed(Literal["a"] | int | None, value, "x")


def test_a_value_that_is_kept_as_it_is_is_no_list():
    assert typed(tuple[int, ...], [1], "x") == (1,)
    with pytest.raises(ConfigError, match=r"x: got \[1\], want a tuple$"):
        typed(tuple[int, ...], [1], "x", convert=False)
