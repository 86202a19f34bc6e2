"""Alternating rounds, and the rows that a benchmark returns.

A row is plain data: `kind` says which of the four kinds it is, and every measured quantity in it is a `Spread`. Ratios
are computed within a round, for bodies that ran one after the other; the median is taken afterwards.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

Row = dict[str, Any]
Spread = dict[str, Any]
"""median, min and max of a quantity over the rounds, and its `values`, one per round"""
K = TypeVar("K")
V = TypeVar("V")
FRAME_SKIP = 4
"""of everybody who plays"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Budget:
    """Length of a measurement."""

    rounds: int
    """rounds after the warm-up"""
    body_s: float
    """seconds of one body in one round"""
    quick: bool
    """smallest sizes: checks that every body runs; the figures have no meaning"""
    peers: Path
    """interpreter of the peers' virtual environment; peers that are not installed there are reported as absent"""


FULL = Budget(rounds=5, body_s=2.5, quick=False, peers=Path(".venv-peers/bin/python"))
QUICK = Budget(rounds=1, body_s=0.3, quick=True, peers=Path(".venv-peers/bin/python"))


def alternate(rounds: int, bodies: Mapping[K, Callable[[], V]], *, warm_up: bool = True) -> dict[K, list[V]]:
    """Runs A, B, C, A, B, C, ... and returns one value of each body per round; the warm-up round is discarded."""
    values: dict[K, list[V]] = {name: [] for name in bodies}
    for number in range(-int(warm_up), rounds):
        for name, body in bodies.items():
            value = body()
            if number >= 0:
                values[name].append(value)
    return values


def seconds_per_call(call: Callable[[], object], body_s: float) -> float:
    """Mean seconds of one call, repeated for `body_s` seconds, at least once."""
    start, count = time.perf_counter(), 0
    while count == 0 or time.perf_counter() - start < body_s:
        call()
        count += 1
    return (time.perf_counter() - start) / count


def spread(values: Sequence[float]) -> Spread:
    """Median, min and max, four significant digits."""
    rounded = [float(f"{value:.4g}") for value in values]
    return {"median": float(np.median(rounded)), "min": min(rounded), "max": max(rounded), "values": rounded}


def ratios(above: Sequence[float], below: Sequence[float]) -> list[float]:
    """above / below, round by round."""
    return [a / b for a, b in zip(above, below, strict=True)]


def rates(
    name: str,
    *,
    decisions_per_s: Sequence[float] | None = None,
    updates_per_s: Sequence[float] | None = None,
    batch_size: int = 32,
) -> Row:
    """The four rates of a candidate; None for a rate that it does not have."""
    row: Row = {"kind": "rates", "name": name}
    for unit, rate, factor in (
        ("decisions", decisions_per_s, 1),
        ("frames", decisions_per_s, FRAME_SKIP),
        ("updates", updates_per_s, 1),
        ("samples", updates_per_s, batch_size),
    ):
        row[f"{unit}_per_s"] = None if rate is None else spread([value * factor for value in rate])
    return row


def measured(name: str, unit: str, values: Sequence[float], *, x: float | None = None, x_unit: str = "") -> Row:
    """One quantity; with `x` it is a point of the curve `name` over `x_unit`."""
    return {"kind": "measured", "name": name, "unit": unit, "x": x, "x_unit": x_unit, **spread(values)}


def goal(
    number: int,
    name: str,
    values: Sequence[float],
    *,
    at_least: float | None = None,
    at_most: float | None = None,
    unit: str = "",
) -> Row:
    """A goal and its measurement; `number` is the section of docs/PERFORMANCE.md. Give one bound."""
    assert (at_least is None) != (at_most is None), "a goal has one bound"
    bounds = {"at_least": at_least, "at_most": at_most}
    return {"kind": "goal", "number": number, "name": name, "unit": unit, **bounds, **spread(values)}


def absent(name: str, why: str) -> Row:
    """A peer or device that could not be measured, and why."""
    return {"kind": "absent", "name": name, "why": why}


def met(row: Row) -> bool:
    """Whether the median of a goal's row keeps its bound."""
    if row["at_least"] is not None:
        return row["median"] >= row["at_least"]
    return row["median"] <= row["at_most"]


def curves(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Name -> points of every curve, in the order of x."""
    points = [row for row in rows if row["kind"] == "measured" and row["x"] is not None]
    names = dict.fromkeys(row["name"] for row in points)
    return {name: sorted((r for r in points if r["name"] == name), key=lambda r: r["x"]) for name in names}
