"""docs/RELIABILITY.md from the committed records of the soak and of the fuzzing: tables between markers, and a plot.

python -m benchmarks.reliability
"""

import json
import sys
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks import hosts_soak, record
from benchmarks.report import between
from benchmarks.soak import DIRECTORY, SCHEMA, kill_ratios, summary
from gvz.core.errors import ConfigError
from gvz.reports.draw import COLOURS

PAGE = record.ROOT / "docs" / "RELIABILITY.md"
RECORDS = (DIRECTORY / "soak.json", DIRECTORY / "fuzz.json")
HOSTS_RECORD = DIRECTORY / "hosts_soak.json"
PLOT = record.ROOT / "docs" / "images" / "reliability_soak.png"
_GROWS = {
    "learner_bytes": "resident memory of the learner",
    "all_bytes": "memory of all processes (proportional set size)",
    "learner_descriptors": "file descriptors of the learner",
    "processes": "processes",
    "shared_memory_files": "files in /dev/shm",
    "shared_memory_bytes": "bytes in /dev/shm",
}


def read(file: Path) -> dict[str, Any]:
    """A record.

    Raises:
        ConfigError: the file is missing or has another schema.
    """
    try:
        made = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: no record ({error}); `make soak` and `make fuzz` make them") from error
    if not isinstance(made, dict) or made.get("schema") != SCHEMA:
        raise ConfigError(f"{file}: want a record of schema {SCHEMA}; `make soak` and `make fuzz` make them")
    return made


def fuzz_table(made: dict[str, Any]) -> str:
    """Inputs tried and edges covered, by target."""
    lines = [
        f"*`{made['command']}`; {made['cpu']}, {made['cores']} cores.*",
        "",
        "| target | inputs | seconds | edges covered | failures | UTC, commit |",
        "|---|---|---|---|---|---|",
        *(
            f"| {name} | {found['inputs']:,} | {found['seconds']:.0f} | {found['edges']:,} | "
            f"{len(found['crashes']) or 'none'} | {found['date'][:16]}, {found['commit']} |"
            for name, found in made["targets"].items()
        ),
        f"| **all** | **{made['inputs']:,}** | | | | |",
    ]
    return "\n".join(lines)


def soak_table(made: dict[str, Any]) -> str:
    """Kills, their cost, growth and losses."""
    ratios, priced, machine = summary(made), kill_ratios(made), made["machine"]
    minutes = sum(s["end_s"] - s["begin_s"] for s in made["stretches"] if s["kind"] == "kills") / 60
    rates = {
        kind: ", ".join(f"{s['updates_per_s']:.2f}" for s in made["stretches"] if s["kind"] == kind)
        for kind in ("undisturbed", "kills")
    }
    lines = [
        f"*{made['date']} UTC, commit {made['commit']}, `{made['command']}`; "
        f"{machine['cpu']}, {machine['cores']} cores.*",
        "",
        "| | |",
        "|---|---|",
        f"| actors killed (SIGKILL) | {len(made['kills'])} in {minutes:.0f} minutes |",
        f"| restarts counted by the run | {made['restarts']} |",
        f"| gradient steps | {made['updates']:,} |",
        "| records lost, repeated or torn | none: a single one would have ended the soak |",
        f"| damaged rows in the records | {made['damaged_rows']} |",
        f"| gradient steps/s, undisturbed stretches | {rates['undisturbed']} |",
        f"| gradient steps/s, stretches with kills | {rates['kills']} |",
        f"| with kills / undisturbed before and after | {ratios['updates_per_s']:.3f} "
        f"[{min(priced):.3f}, {max(priced):.3f}] |",
        *(f"| {text}, last fifth / first fifth | {ratios[name]:.3f} |" for name, text in _GROWS.items()),
        f"| exit code after SIGTERM | {made['exit_code']} |",
        f"| left behind | {', '.join(made['left_behind']) or 'nothing'} |",
        "",
        f"![memory, descriptors, shared memory, processes and gradient steps/s over the soak](images/{PLOT.name})",
    ]
    return "\n".join(lines)


def draw(made: dict[str, Any], out: Path) -> None:
    """One panel for each quantity that must not grow, the kills as ticks, and the rates of the stretches."""
    minutes = [s / 60 for s in made["samples"]["time_s"]]
    panels = {
        "memory, GB": {"learner": ("learner_bytes", 1e9), "all processes": ("all_bytes", 1e9)},
        "descriptors, processes, files": {
            "learner's descriptors": ("learner_descriptors", 1),
            "processes": ("processes", 1),
            "files in /dev/shm": ("shared_memory_files", 1),
        },
    }
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    all_axes = figure.subplots(3, 1, sharex=True)
    for axes, (label, curves) in zip(all_axes, panels.items(), strict=False):
        axes.set_prop_cycle(color=COLOURS)
        for name, (column, unit) in curves.items():
            axes.plot(minutes, [value / unit for value in made["samples"][column]], label=name, linewidth=1)
        axes.set(ylabel=label, ylim=(0, None))
        axes.legend(loc="lower right", fontsize=8)
    rates = all_axes[2]
    for kind, colour in zip(("undisturbed", "kills"), COLOURS, strict=False):
        mine = [stretch for stretch in made["stretches"] if stretch["kind"] == kind]
        begins, ends = ([stretch[end] / 60 for stretch in mine] for end in ("begin_s", "end_s"))
        values = [stretch["updates_per_s"] for stretch in mine]
        rates.hlines(values, begins, ends, color=colour, linewidth=3, label="with kills" if kind == "kills" else kind)
    kills = [kill / 60 for kill in made["kills"]]
    rates.plot(kills, [0.25] * len(kills), "k|", label="kill")
    rates.set(xlabel="minutes", ylabel="gradient steps/s", ylim=(0, None))
    rates.legend(loc="center right", bbox_to_anchor=(1.0, 0.35), fontsize=8)
    figure.savefig(out, dpi=110, metadata={"Software": None})


def write_page(page: str, soak: dict[str, Any], fuzz: dict[str, Any]) -> str:
    """The page with what the two records, and that of the hosts' soak, give between its markers.

    Raises:
        ConfigError: a marker is missing.
    """
    command = "python -m benchmarks.reliability"
    page = between(page, PAGE, "soak", soak_table(soak), command)
    hosts = read(HOSTS_RECORD) if HOSTS_RECORD.exists() else None
    page = between(page, PAGE, "hosts_soak", hosts_soak.table(hosts), command)
    return between(page, PAGE, "fuzz", fuzz_table(fuzz), command)


def main() -> int:
    """Writes page and plot; returns the exit code."""
    try:
        soak, fuzz = map(read, RECORDS)
        PAGE.write_text(write_page(PAGE.read_text(), soak, fuzz))
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    draw(soak, PLOT)
    for file in (PAGE, PLOT):
        print(file.relative_to(record.ROOT))
    return 0


if __name__ == "__main__":
    sys.exit(main())
