"""Fields of configurations that are numbers within a range."""

from functools import cache
from typing import Annotated, NamedTuple, get_type_hints

from gvz.core.errors import ConfigError


class Range(NamedTuple):
    """What a field may be, ends included: `Annotated[float, Range(0.0, 10.0)]`."""

    low: float
    high: float


Share = Annotated[float, Range(0.0, 1.0)]


@cache
def _ranges(kind: type) -> dict[str, Range]:
    """The ranges of a class's fields. A field whose default alone is changed in a subclass keeps its range."""
    return {
        name: item
        for owner in reversed(kind.__mro__)
        for name, hint in get_type_hints(owner, include_extras=True).items()
        for item in getattr(hint, "__metadata__", ())
        if isinstance(item, Range)
    }


def check_ranges(prefix: str, config: object) -> None:
    """Raises ConfigError for the first field outside its range; None passes (a value to be derived)."""
    for name, (low, high) in _ranges(type(config)).items():
        value = getattr(config, name)
        if value is not None and not low <= value <= high:
            raise ConfigError(f"{prefix}.{name}: got {value}, want {low:.10g}..{high:.10g}")
