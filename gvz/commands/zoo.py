"""`gvz zoo`: the trained policies that come with GViZDoom."""

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import tyro

from gvz.core.errors import ConfigError, GvzError
from gvz.core.registry import NO_OWN_FILES, OwnFiles
from gvz.evaluation.zoo import PREFIX, pack, run_directory, score_card, zoo_names
from gvz.run.rundir import EVALUATION_RECORDS

if TYPE_CHECKING:
    from gvz.run.config import RunConfig


@dataclass(frozen=True, kw_only=True)
class Zoo:
    """List the trained policies that come with GViZDoom; with names, show their training tasks and their scores.

    `zoo:NAME` stands for a policy wherever a command takes a run directory.

    Examples: gvz zoo seek_and_kill
              gvz watch zoo:dodge_projectiles --task dodge_projectiles/mancubus
              gvz zoo --add runs/rainbow_general/seed_1111 --name my_seek_and_kill
    """

    names: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[NAME ...]", help_behavior_hint="")
    ] = ()
    """policies to show in detail"""
    add: Path | None = None
    """run directory whose policy is put into the zoo of this checkout, rounded; with `zoo:NAME`, its score card is
    renewed by the episodes that were evaluated of it"""
    name: str | None = None
    """of the policy that is added"""
    replace: bool = False
    """take the place of another policy of that name"""
    checkpoint: str = "newest"
    """which of the run's policies is added: gradient steps, or newest"""
    own_files: Annotated[OwnFiles, tyro.conf.arg(name="")] = NO_OWN_FILES

    def run(self) -> int:
        """Prints the policies, or what was added. A list says of a policy that cannot be read why."""
        if (self.add is None) != (self.name is None):
            raise ConfigError("zoo: want --add and --name together")
        if self.add is None and (self.replace or self.checkpoint != "newest"):
            raise ConfigError("zoo: got --replace or --checkpoint, want them with --add alone")
        if self.add is not None and self.name is not None:
            if self.names:
                raise ConfigError(f"zoo: got {' '.join(self.names)} beside --add; the policy's name is that of --name")
            if self.name in zoo_names() and not self.replace and str(self.add) != f"{PREFIX}{self.name}":
                raise ConfigError(f"--name: the zoo has a policy {self.name} already; give another name, or --replace")
            packed = pack(run_directory(self.add), self.name, self.checkpoint, self.own_files)
            print(f"{packed.file}: {packed.num_updates:,} updates, {packed.num_bytes:,} bytes")
            if not packed.num_episodes:
                print(f"no score card yet: gvz evaluate {PREFIX}{self.name}, then add {PREFIX}{self.name} again")
        elif self.names:
            print("\n\n".join(_card(_read(name.removeprefix(PREFIX), self.own_files)) for name in self.names))
        elif known := zoo_names():
            print(_table({name: _read_or_why_not(name, self.own_files) for name in known}))
        else:
            print("the zoo is empty")
        return 0


COMMAND = Zoo


class _Policy(NamedTuple):
    """What a policy's file says."""

    name: str
    config: "RunConfig"
    num_updates: int
    processor_s: float | None
    """that training took; None: not recorded"""
    num_test_tasks: int
    scores: list[dict[str, Any]]
    """`score_rows` of those that were evaluated"""


def _read_or_why_not(name: str, own_files: OwnFiles) -> _Policy | str:
    try:
        return _read(name, own_files)
    except GvzError as error:
        return str(error)


def _read(name: str, own_files: OwnFiles) -> _Policy:
    from gvz.core import records
    from gvz.evaluation.selection import TaskSelection
    from gvz.evaluation.table import score_rows
    from gvz.evaluation.trained import find_checkpoints, read_run_config

    directory = run_directory(Path(f"{PREFIX}{name}"))
    config = read_run_config(directory, own_files)
    [num_updates] = find_checkpoints(directory, ["newest"])
    rows = score_card(records.read_stored(directory / EVALUATION_RECORDS)[0])
    metrics, _ = records.read_stored(directory / "metrics.jsonl")
    tasks = TaskSelection(split="test").of_run([scenario.id for scenario in config.table.scenarios])
    scores = score_rows(rows, tasks)
    spent_s = metrics[-1].get("run/processor_s") if metrics else None
    return _Policy(name, config, num_updates, spent_s, len(tasks), scores)


def _table(policies: Mapping[str, _Policy | str]) -> str:
    """A line for each policy, or why it cannot be read; the score is the mean over the test tasks."""
    from gvz.evaluation.table import interval_text

    width = max(map(len, policies)) + len(PREFIX)
    lines = [f"{'policy':{width}}  {'frames':9}  trained on  updates  processor time  % of the bound, test tasks [95%]"]
    for name, policy in policies.items():
        if isinstance(policy, str):
            lines.append(f"{PREFIX + name:{width}}  error: {policy}")
            continue
        tasks = f"{len(policy.config.table.ids)} tasks"
        spent = "" if policy.processor_s is None else f"{policy.processor_s:,.0f} s"
        played, of_all = sum(row["task"] is not None for row in policy.scores), policy.num_test_tasks
        score = f"{played} of {of_all} tasks evaluated"
        if played == of_all:
            score = interval_text(policy.scores[-1], "normalized_score")
        lines.append(
            f"{PREFIX + name:{width}}  {policy.config.env.frames:9}  {tasks:>10}  {policy.num_updates:7,}  "
            f"{spent:>14}  {score}"
        )
    return "\n".join([*lines, "", "gvz zoo NAME shows a policy's training tasks, and its score on each test task."])


def _card(policy: _Policy) -> str:
    """A policy's lines: what it was trained on, for how long, and its scores."""
    from gvz.evaluation.table import score_lines

    spent = "" if policy.processor_s is None else f", {policy.processor_s:,.0f} s of processor time"
    config, trained_on = policy.config, f"trained on {', '.join(policy.config.table.ids)}"
    lines = [
        f"{PREFIX}{policy.name}: {config.name}, seed {config.seed}, {policy.num_updates:,} updates{spent}",
        textwrap.fill(trained_on, 120, subsequent_indent="  ", break_on_hyphens=False),
    ]
    return "\n".join([*lines, *(score_lines(policy.scores) if policy.scores else ["no evaluation"])])
