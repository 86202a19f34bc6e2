"""`gvz segmenter`: trains the network of segmented frames."""

import contextlib
import json
import math
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import tyro

from gvz.core.control_groups import keep_xla_to_quota
from gvz.core.errors import ConfigError
from gvz.core.files import written_whole

_LOOK_PERIOD_STEPS = 20
"""between two looks at the time"""
_BATCHES_AHEAD = 4
"""of each worker"""
_DIED = "gvz segmenter: a worker process died, perhaps for want of memory; give it fewer --workers or --frames"
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class TrainSegmenter:
    """Train a network that tells from the screen what each part of it shows, for `--env.frames segmented`.

    It learns from frames of a scenario's training tasks with the engine's labels, seen by a random player and by the
    scripted one, and changed in many ways. It is then scored on frames of the gate tasks. Whoever plays with it needs
    no labels.

    Example: gvz segmenter --scenario seek_and_kill --out segmenter.onnx
    """

    scenario: str
    """whose tasks"""
    out: Path
    """the ONNX file to write; beside it comes a .json file with what it was trained on, and its scores"""
    training_set: Literal["train4", "train8", "train8_varied"] = "train8"
    """the tasks that it learns from; train8_varied: the eight, and on varied maps those of them that change no
    texture"""
    frames: int = 1500
    """labelled frames of each training task"""
    gate_frames: int = 300
    """of each gate task, for the scores"""
    processor_s: float = 1_600.0
    """seconds of processor time, of games and learning in all processes together, after which training ends"""
    batch_size: int = 8
    """frames of a gradient step"""
    workers: int = 0
    """processes that play and change frames while this one learns, to keep a GPU busy; with 0 this one does it all.
    They share the frames in files of the temporary directory (TMPDIR), 185 KB each"""
    tints_and_patches: Annotated[bool, tyro.conf.arg(help_behavior_hint="")] = True
    """leave walls and floors as they are. By default, those of some frames get tints and patches: the network is then
    better in Health Gathering, worse in Seek and Kill (docs/findings/segmented-frames.md)"""
    seed: int = 1111
    """of the first parameters and of the changes of frames"""

    def run(self) -> int:
        """Plays, trains, scores, writes."""
        for name, least in (("frames", 1), ("gate_frames", 1), ("batch_size", 1), ("workers", 0), ("seed", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"--{name.replace('_', '-')}: got {getattr(self, name)}, want at least {least}")
        if not 0 < self.processor_s < math.inf:
            raise ConfigError(f"--processor-s: got {self.processor_s:g}, want more than 0")
        if self.out.suffix != ".onnx":
            raise ConfigError(f"--out: got {self.out}, want a name that ends in .onnx")
        if find_spec("onnx") is None:
            raise ConfigError("gvz segmenter: the package onnx is missing; pip install 'gvizdoom[segmenter]'")
        from gvz.tasks import named_tasks

        gate_tasks = named_tasks(self.scenario, split="gate")
        keep_xla_to_quota()
        import jax
        import numpy as np

        from gvz.core import janitor
        from gvz.evaluation import segmentation
        from gvz.evaluation.workers import worker_processes
        from gvz.run import machine
        from gvz.run.bars import Bar, Bars
        from gvz.segmentation import INPUT_HEIGHT, INPUT_WIDTH, Segmenter
        from learner.segmentation import train_segmentation, write_onnx

        tasks = named_tasks(self.scenario, split=self.training_set)
        of_machine = machine.describe()  # with the commit of the code that is loaded now
        begun_s = machine.processor_s()
        with contextlib.ExitStack() as until_trained, Bars(line_period_s=10.0) as bars:
            unfinished = until_trained.enter_context(written_whole(self.out))

            def show(unit: str, done: int, total: int, text: str) -> None:
                bars.show([Bar(name=unit, done=done, total=total, unit=unit, text=text)])

            def played(found: Iterable[T]) -> Iterator[T]:
                """Shows which task comes next."""
                found = iter(found)
                for number, task in enumerate(tasks):
                    show("tasks", number, len(tasks), f"frames of {task.id}")
                    yield next(found)

            spec = segmentation.BatchSpec(self.batch_size, self.seed, self.tints_and_patches)
            if self.workers:
                directory = until_trained.enter_context(janitor.temporary_directory())
                executor = until_trained.enter_context(worker_processes(self.workers, _DIED))
                keep = partial(segmentation.keep_frames, num_frames=self.frames, directory=directory)
                list(played(executor.map(keep, tasks)))
                num_ahead = _BATCHES_AHEAD * self.workers
                batches = segmentation.batches_of_workers(executor, num_ahead, tasks, directory, spec)
            else:
                labelled = list(played(segmentation.labelled_frames(task, self.frames) for task in tasks))
                batches = segmentation.Batches(labelled, spec)

            spent_s = 0.0

            def share_done(num_steps: int, loss: float) -> float:
                nonlocal spent_s
                if num_steps % _LOOK_PERIOD_STEPS == 0:
                    spent_s = machine.processor_s() - begun_s
                    text = f"processor seconds, gradient step {num_steps:,}, loss {loss:.3f}"
                    show("s", round(spent_s), round(self.processor_s), text)
                return spent_s / self.processor_s

            weights, key = segmentation.CLASS_WEIGHTS, jax.random.key(self.seed)
            params, steps, loss = train_segmentation(batches, weights, key, share_done)
            spent_s = machine.processor_s() - begun_s
            if steps == 0:
                raise ConfigError(
                    f"--processor-s: got {self.processor_s:g}, but the games alone took {spent_s:.0f} s; give more, or "
                    "fewer --frames"
                )
            write_onnx(params, unfinished, INPUT_HEIGHT, INPUT_WIDTH)
            record_file = self.out.with_suffix(".json")
            record_file.unlink(missing_ok=True)  # of a network that was there before
            until_trained.close()
            segment, scores = Segmenter(str(self.out)), {}
            for task in gate_tasks:
                show("tasks", len(scores), len(scores) + 1, f"scores on {task.id}")
                gate = segmentation.labelled_frames(task, self.gate_frames)
                scores[task.id] = segmentation.score(np.stack([segment(frame) for frame in gate.frames]), gate.labels)
        record = {
            "scenario": self.scenario,
            "tasks": [task.id for task in tasks],
            "frames_per_task": self.frames,
            "seed": self.seed,
            "gradient_steps": steps,
            "batch_size": self.batch_size,
            "workers": self.workers,
            "tints_and_patches": self.tints_and_patches,
            "processor_s": round(spent_s, 1),
            "loss": round(loss, 4),
            "machine": of_machine,
            "average_precision": {task: {k: round(v, 3) for k, v in found.items()} for task, found in scores.items()},
        }
        with written_whole(record_file) as writing:
            writing.write_text(json.dumps(record, indent=2) + "\n")
        print(f"{self.out}: {steps:,} gradient steps in {spent_s:,.0f} processor seconds", file=sys.stderr)
        for task, found in scores.items():
            print(f"{task}: " + ", ".join(f"{name} {value:.2f}" for name, value in found.items()))
        return 0


COMMAND = TrainSegmenter
