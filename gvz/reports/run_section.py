"""Sections on the runs themselves: time and rates, configuration, raw records and videos.

Imports polars, gvz.reports.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import polars as pl

from gvz.evaluation.frame import evaluation_files
from gvz.reports.document import Block, Link, Section, Table, missing, words
from gvz.reports.results import Results, Run, training_time_s

_VIDEOS = (".mp4", ".gif", ".webp", ".webm")


def run_sections(results: Results, out: Path) -> list[Section]:
    """What there is to say of the runs; nothing without any."""
    sections = []
    if results.runs:
        sections.append(
            Section(id="runs", title="Time and throughput", blocks=(Block(tables=(_rates(results.runs),)),))
        )
        sections.append(
            Section(id="configuration", title="Configuration", blocks=(Block(tables=(_configurations(results),)),))
        )
    return [*sections, Section(id="records", title="Raw records", blocks=(_links(results, out),))]


def _rates(runs: Sequence[Run]) -> Table:
    rows = []
    for run in runs:
        if run.metrics.is_empty():
            rows.append((words(run.id), *[missing("no metrics")] * 6))
            continue
        last = run.metrics.tail(1).row(0, named=True)
        medians = run.metrics.select(
            pl.median("learner/updates_per_s", "actors/decisions_per_s", "actors/frames_per_s")
        ).row(0)
        rows.append(
            (
                words(run.id),
                words(f"{last['num_updates']:,} of {run.total_updates:,}"),
                words("-" if last["actors/env_steps"] is None else f"{last['actors/env_steps']:,}"),
                words(_hours(training_time_s(run.metrics))),
                *(words("-" if rate is None else f"{rate:,.0f}") for rate in medians),
            )
        )
    return Table(
        id="throughput",
        caption="Wall-clock time of training (pauses between a stop and the next start do not count) and median rates.",
        columns=(
            *("run", "gradient steps", "env steps", "hours:minutes:seconds"),
            *("updates/s", "decisions/s", "frames/s"),
        ),
        rows=tuple(rows),
    )


def _hours(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{seconds:02}"


def _configurations(results: Results) -> Table:
    """Every field as a row, every agent as a column; seeds and directories left out, equal values said once."""
    configs: dict[str, dict[str, Any]] = {}
    for run in results.runs:
        flat = _flat(run.config)
        for name in ("seed", "run_dir", "tasks", "scenario", "training_set", "name"):
            flat.pop(name, None)
        configs.setdefault(run.name, flat)
    fields = list(dict.fromkeys(field for config in configs.values() for field in config))
    rows = []
    for field in fields:
        values = [str(config.get(field, "-")) for config in configs.values()]
        rows.append((words(field), *(words(value) for value in values)))
    differ = [row for row in rows if len({cell.text for cell in row[1:]}) > 1]
    return Table(
        id="configurations",
        caption="Configuration of each agent's first run" + (", what differs first." if len(configs) > 1 else "."),
        columns=("field", *configs),
        rows=(*differ, *(row for row in rows if row not in differ)),
    )


def _flat(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in config.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


def _links(results: Results, out: Path) -> Block:
    """Every file the report was made from, and what videos lie beside them."""
    files = evaluation_files(results.paths)
    for run in results.runs:
        files += [file for name in ("config.json", "metrics", "episodes") for file in sorted(run.path.glob(f"{name}*"))]
    for path in results.paths:
        files += [file for file in sorted(path.rglob("*")) if file.suffix in _VIDEOS] if path.is_dir() else []
    links = [Link(text=str(file), target=os.path.relpath(file.resolve(), out.resolve())) for file in files]
    text = "Every number above can be computed anew from these files (docs/REPORTS.md says how)."
    return Block(text=(text,), links=tuple(links))
