"""`gvz segmenter`: trains the network of segmented frames."""

import json
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from gvz.core.errors import ConfigError

TrainSet = Literal["train4", "train8"]
_BATCH_SIZE = 8
_SHOW_PERIOD_STEPS = 20


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
    training_set: TrainSet = "train8"
    """the tasks that it learns from"""
    frames: int = 1500
    """labelled frames of each training task"""
    gate_frames: int = 300
    """of each gate task, for the scores"""
    processor_s: float = 1_600.0
    """seconds of processor time, of games and learning together, after which training ends"""
    seed: int = 1111
    """of the first parameters and of the changes of frames"""

    def run(self) -> int:
        """Plays, trains, scores, writes."""
        for name in ("frames", "gate_frames"):
            if getattr(self, name) < 1:
                raise ConfigError(f"--{name.replace('_', '-')}: got {getattr(self, name)}, want at least 1")
        if self.processor_s <= 0:
            raise ConfigError(f"--processor-s: got {self.processor_s:g}, want more than 0")
        if self.out.suffix != ".onnx":
            raise ConfigError(f"--out: got {self.out}, want a name that ends in .onnx")
        if not self.out.parent.is_dir():
            raise ConfigError(f"--out: {self.out.parent} is no directory")
        if find_spec("onnx") is None:
            raise ConfigError("gvz segmenter: the package onnx is missing; pip install 'gvizdoom[segmenter]'")
        from gvz.tasks import named_tasks

        tasks = named_tasks(self.scenario, split=self.training_set)
        import jax
        import numpy as np

        from gvz.evaluation.segmentation import CLASS_WEIGHTS, labelled_frames, score, training_batches
        from gvz.run import machine
        from gvz.run.bars import Bar, Bars
        from gvz.segmentation import INPUT_HEIGHT, INPUT_WIDTH, Segmenter
        from learner.segmentation import train_segmentation, write_onnx

        of_machine = machine.describe()  # with the commit of the code that is loaded now
        begun_s, steps, loss = machine.processor_s(), 0, 0.0
        with Bars(line_period_s=10.0) as bars:

            def show(unit: str, done: int, total: int, text: str) -> None:
                bars.show([Bar(name=unit, done=done, total=total, unit=unit, text=text)])

            labelled = []
            for task in tasks:
                show("tasks", len(labelled), len(tasks), f"frames of {task.id}")
                labelled.append(labelled_frames(task, self.frames))

            def share_done(num_steps: int, last_loss: float) -> float:
                nonlocal steps, loss
                steps, loss = num_steps, last_loss
                spent_s = machine.processor_s() - begun_s
                if num_steps % _SHOW_PERIOD_STEPS == 0:
                    text = f"processor seconds, gradient step {num_steps:,}, loss {loss:.3f}"
                    show("s", round(spent_s), round(self.processor_s), text)
                return spent_s / self.processor_s

            batches = training_batches(labelled, _BATCH_SIZE, self.seed)
            params = train_segmentation(batches, CLASS_WEIGHTS, jax.random.key(self.seed), share_done)
            write_onnx(params, self.out, INPUT_HEIGHT, INPUT_WIDTH)
            spent_s = machine.processor_s() - begun_s
            segment, scores = Segmenter(str(self.out)), {}
            for task in named_tasks(self.scenario, split="gate"):
                show("tasks", len(scores), len(scores) + 1, f"scores on {task.id}")
                gate = labelled_frames(task, self.gate_frames)
                scores[task.id] = score(np.stack([segment(frame) for frame in gate.frames]), gate.labels)
        record = {
            "scenario": self.scenario,
            "tasks": [task.id for task in tasks],
            "frames_per_task": self.frames,
            "seed": self.seed,
            "gradient_steps": steps,
            "batch_size": _BATCH_SIZE,
            "processor_s": round(spent_s, 1),
            "loss": round(loss, 4),
            "machine": of_machine,
            "average_precision": {task: {k: round(v, 3) for k, v in found.items()} for task, found in scores.items()},
        }
        self.out.with_suffix(".json").write_text(json.dumps(record, indent=2) + "\n")
        print(f"{self.out}: {steps:,} gradient steps in {spent_s:,.0f} processor seconds", file=sys.stderr)
        for task, found in scores.items():
            print(f"{task}: " + ", ".join(f"{name} {value:.2f}" for name, value in found.items()))
        return 0


COMMAND = TrainSegmenter
