"""Fuzz targets: what a person types. Task names, the command line of the trainer, names of configs and checkpoints.

Imports gvz.run.{config,config_files}, gvz.{launch,tasks}, gvz.evaluation.trained, gvz.experiments.plan.
"""

import contextlib
import io
import json
from pathlib import Path

from gvz.core.errors import ConfigError, TaskError
from gvz.evaluation.trained import find_checkpoints
from gvz.experiments.plan import parse_shard
from gvz.launch import parse
from gvz.run.config_files import config_from_dict, config_to_dict, configs_directory, find_config_file
from gvz.run.resume import differences
from gvz.tasks import named_tasks, parse_task, scenarios
from tests.fuzz.target import Target

CONFIGS = sorted(file.stem for file in configs_directory().glob("*.py") if file.stem != "__init__")


def task_name(_directory: Path) -> Target:
    """The id of a task."""

    def run(data: bytes) -> bool:
        try:
            task = parse_task(data.decode(errors="surrogateescape"))
        except TaskError:
            return False
        assert parse_task(task.id) == task
        assert 0 <= task.level <= 4
        groups = [group for name in task.attributes for group in task.scenario.attribute(name).groups]
        assert len(set(groups)) == len(groups)
        return True

    attributes = sorted({name for one in scenarios().values() for a in one.attributes for name in (a.name, *a.aliases)})
    words = [*scenarios(), *attributes, "default", "complete", "/", "+"]
    return Target(
        run=run,
        seeds=[task.id.encode() for task in named_tasks()] + [b"defend_the_center/gore+mossy_bricks"],
        words=[word.encode() for word in words],
        max_bytes=512,
    )


def command_line(_directory: Path) -> Target:
    """Flags of `python -m gvz.launch`, one a line: overrides of a configuration."""

    def run(data: bytes) -> bool:
        arguments = data.decode(errors="surrogateescape").split("\n")
        if any(a.startswith("--config") or "tyro" in a for a in arguments):
            return False  # the one executes a file, the other writes one, as they are meant to
        output = io.StringIO()
        code = None
        try:
            with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
                config = parse(arguments).run
        except (ConfigError, TaskError):
            return False
        except SystemExit as end:
            code = end.code
        if code is not None:
            assert code in (0, 2), code  # 0: --help
            assert output.getvalue(), "it ended without a word"
            return False
        again = config_from_dict(json.loads(json.dumps(config_to_dict(config))))
        assert differences(again, config) == []
        return True

    flags = """--seed 5|--mode sync|--tasks defend_the_center/gore|--env.frame-height 36|--agent.v-min -1
        --agent.v-max 2.5|--actors.num-actors 3|--actors.games-per-actor 4|--replay.capacity 5000
        --learner.batch-size 8|--training-set 8
        --agent.conv-channels 8 8|--agent.conv-kernels 8 4|--agent.conv-strides 4 2|--agent.noisy off|--agent.no-double
        --learner.max-grad-norm 1e3|--run-dir x|--name y|--env.buffers depth|--checkpoint.keep 1
        --scenario seek_and_kill"""
    groups = ["\n".join(group.split()).encode() for line in flags.split("\n") for group in line.split("|")]
    words = [word for group in groups for word in group.split(b"\n")] + [b"\n", b"nan", b"-1", b"0", b"None", b"1e400"]
    return Target(run=run, seeds=[b"\n".join(groups[:6]), *groups], words=words, max_bytes=512, num_inputs=40)


def config_name(_directory: Path) -> Target:
    """What --config names."""

    def run(data: bytes) -> bool:
        try:
            assert find_config_file(data.decode(errors="surrogateescape")).is_file()
        except ConfigError:
            return False
        return True

    seeds = [name.encode() for name in CONFIGS] + [b"rainbow_4task.py", b"./mine.py", b"/dev/null", b"a" * 300]
    return Target(run=run, seeds=seeds, words=[b"/", b"..", b".py", b"\0", b"~"], max_bytes=5000)


def checkpoint_choice(directory: Path) -> Target:
    """What --checkpoints and --shard take."""
    for name in ("10", "20", "007", "x", "\u00b2", ".writing-30-1"):
        (directory / "policies" / name).mkdir(parents=True, exist_ok=True)

    def run(data: bytes) -> bool:
        text, taken = data.decode(errors="surrogateescape"), False
        with contextlib.suppress(ConfigError):
            chosen = find_checkpoints(directory, text.split("\n"))
            assert chosen
            assert set(chosen) <= {7, 10, 20}
            taken = True
        with contextlib.suppress(ConfigError):
            index, count = parse_shard(text)
            assert 1 <= index <= count
            taken = True
        return taken

    seeds = [b"newest", b"all", b"last2", b"10\n20", b"1/3"]
    return Target(
        run=run, seeds=seeds, words=[b"last", b"9" * 5000, b"0", b"-", b"/", "\u0663".encode()], max_bytes=6000
    )
