"""`gvz zoo`: the trained policies that come with GViZDoom."""

from dataclasses import dataclass
from pathlib import Path

from gvz.core.errors import ConfigError
from gvz.evaluation.zoo import PREFIX, pack, run_directory, zoo_names


@dataclass(frozen=True, kw_only=True)
class Zoo:
    """List the trained policies that come with GViZDoom, with the tasks, the budget and the scores of each.

    `zoo:NAME` stands for a policy wherever a command takes a run directory.

    Examples: gvz watch zoo:dodge_projectiles --task dodge_projectiles/mancubus
              gvz zoo --add runs/rainbow_general/seed_1111 --name seek_and_kill
    """

    add: Path | None = None
    """run directory whose policy is put into the zoo of this checkout, rounded; with `zoo:NAME`, its score card is
    renewed by the episodes that were evaluated of it"""
    name: str | None = None
    """of the policy that is added"""
    checkpoint: str = "newest"
    """which of the run's policies is added: gradient steps, or newest"""
    agent: Path | None = None
    """the Python file of the run's agent, if it is in a file of its own"""

    def run(self) -> int:
        """Prints the table, or what was added."""
        if (self.add is None) != (self.name is None):
            raise ConfigError("zoo: want --add and --name together")
        if self.add is not None and self.name is not None:
            packed = pack(run_directory(self.add), self.name, self.checkpoint, self.agent)
            print(f"{packed.file}: {packed.num_updates:,} updates, {packed.num_bytes:,} bytes")
            if not packed.num_episodes:
                print(f"no score card yet: gvz evaluate {PREFIX}{self.name}, then add {PREFIX}{self.name} again")
            return 0
        names = zoo_names()
        if not names:
            print("the zoo is empty")
        for name in names:
            print("\n".join(_card(name)))
        return 0


COMMAND = Zoo
_NAMED_TASKS = 8
"""of those that a policy was trained on; of more, their number is said"""


def _card(name: str) -> list[str]:
    """A policy's lines: what it was trained on, for how long, and its scores."""
    from gvz.core import records
    from gvz.evaluation.selection import TaskSelection
    from gvz.evaluation.table import score_lines, score_rows
    from gvz.evaluation.trained import find_checkpoints, read_run_config

    directory = run_directory(Path(f"{PREFIX}{name}"))
    config = read_run_config(directory)
    [num_updates] = find_checkpoints(directory, ["newest"])
    rows, _ = records.read_stored(directory / "evaluation.jsonl")
    metrics, _ = records.read_stored(directory / "metrics.jsonl")
    spent = f", {metrics[-1]['run/processor_s']:,.0f} s of processor time" if metrics else ""
    trained_on, others = ", ".join(config.table.ids[:_NAMED_TASKS]), len(config.table.ids[_NAMED_TASKS:])
    more = f" and {others} more tasks" if others else ""
    head = (
        f"{PREFIX}{name}: {config.name}, seed {config.seed}, {num_updates:,} updates{spent}, "
        f"trained on {trained_on}{more}"
    )
    tasks = TaskSelection(split="test").of_run([scenario.id for scenario in config.table.scenarios])
    found = score_rows(rows, {}, tasks, episodes=10**9)
    return [head, *(f"  {line}" for line in (score_lines(found) if found else ["no evaluation"])), ""]
