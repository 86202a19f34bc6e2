"""Jobs: what to do for one run (train, then evaluate) or one simple player.

The next command follows from the files on the disk, so an interrupted job goes on.
"""

import json
from dataclasses import dataclass
from pathlib import Path

from gvz.evaluation.simple import SimplePlayerName
from gvz.experiments import inventory
from gvz.experiments.base import TrainingRun
from gvz.experiments.plan import Evaluation
from gvz.experiments.scale import scaled_settings
from gvz.run.config_files import Settings, config_from_dict, settings_flags, with_settings
from gvz.run.resume import differences
from gvz.run.rundir import EVALUATION_RECORDS


@dataclass(frozen=True, kw_only=True, slots=True)
class Command:
    """One step of a job, as arguments of Python."""

    step: str
    """train or evaluate"""
    arguments: tuple[str, ...]
    total: int
    """what `Job.done_count` gives when the job is done; episodes that the plan does not ask for are among them"""
    unit: str = "updates"
    """what `total` counts"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Outlook:
    """What is left of a job."""

    next: Command | None
    """None: the job is done"""
    begun: bool
    """there are files of it on the disk"""
    text: str
    """how far it is, for a person"""


@dataclass(frozen=True, kw_only=True, slots=True)
class RunJob:
    """Trains a run and evaluates its checkpoints."""

    results: Path
    """the results directory"""
    run: TrainingRun
    evaluation: Evaluation
    scale: float

    @property
    def id(self) -> str:
        """Unique in the results directory; names the log."""
        return self.run.id

    def outlook(self) -> Outlook:
        """What is left, by the run's directory."""
        now = inventory.run_progress(self.results, self.run, self.evaluation)
        total = len(self.evaluation.tasks) * self.evaluation.episodes * self.run.num_checkpoints
        played = total - now.lacking(self.evaluation) if now.trained else 0
        goal, unit, limit_s = self.run.total_updates, "updates", self.run.max_processor_s
        trained = f"{now.num_updates:,}/{goal:,} updates"
        if limit_s is not None:
            goal, unit = round(limit_s), "processor seconds"
            trained = f"{now.num_updates:,} updates in {now.processor_s:,.0f}/{limit_s:,.0f} {unit}"
        text = f"{trained}, {played:,}/{total:,} episodes"
        directory, following = inventory.run_directory(self.results, self.run), None
        if not now.trained:
            arguments = ("-m", "gvz.launch", *training_flags(self.run, self.scale), "--run-dir", str(directory))
            following = Command(step="train", arguments=arguments, total=goal, unit=unit)
        elif now.missing:
            which = (str(directory), "--checkpoints", *map(str, now.missing))
            own = self.run.run_config.own_files._asdict().items()
            files = [text for name, file in own if file is not None for text in (f"--{name}", str(file))]
            arguments = ("-m", "gvz.cli", "evaluate", *which, *files, *_episodes(self.evaluation))
            goal = inventory.count_rows(directory / EVALUATION_RECORDS) + sum(now.missing.values())
            following = Command(step="evaluate", arguments=arguments, total=goal, unit="episodes")
        return Outlook(next=following, begun=now.num_updates > 0, text=text)

    def other_settings(self) -> list[str]:
        """`field: as it is -> as the plan has it`, of a run that is trained: nobody else would see it."""
        directory = inventory.run_directory(self.results, self.run)
        file = directory / "config.json"
        if not file.exists() or not inventory.run_progress(self.results, self.run, self.evaluation).trained:
            return []
        try:
            saved = config_from_dict(json.loads(file.read_text()), self.run.run_config.own_files)
        except (ValueError, OSError, RecursionError) as error:
            return [f"{file} cannot be read: {error}"]
        games = {"actors.num_actors": saved.num_actors, "actors.games_per_actor": saved.games_per_actor}
        found = differences(saved, with_settings(self.run.run_config, {**_settings(self.run, self.scale), **games}))
        limit_s = self.run.max_processor_s  # a resumed run may have another limit; what it has used up, it keeps
        if limit_s not in (None, saved.max_processor_s) and inventory.last_processor_s(directory) >= limit_s:
            found.append(f"max_processor_s: {saved.max_processor_s} -> {limit_s}")
        return found

    def done_count(self, step: str) -> int:
        """How much of `Command.total` is done: gradient steps, processor seconds or episodes in the records."""
        directory = inventory.run_directory(self.results, self.run)
        if step == "train":
            by_time = self.run.max_processor_s is not None
            return int(inventory.last_processor_s(directory)) if by_time else inventory.last_update(directory)
        return inventory.count_rows(directory / EVALUATION_RECORDS)


@dataclass(frozen=True, kw_only=True, slots=True)
class PlayerJob:
    """Plays the evaluation episodes as a player that needs no training."""

    results: Path
    player: SimplePlayerName
    evaluation: Evaluation

    @property
    def id(self) -> str:
        return f"players/{self.player}"

    def outlook(self) -> Outlook:
        """What is left, by the player's record file."""
        missing = inventory.missing_player_episodes(self._file, self.evaluation)
        total = len(self.evaluation.tasks) * self.evaluation.episodes
        arguments = ("-m", "gvz.cli", "evaluate", "--player", self.player, "--out", str(self._file))
        arguments = (*arguments, *_episodes(self.evaluation))
        goal = inventory.count_rows(self._file) + missing
        following = Command(step="evaluate", arguments=arguments, total=goal, unit="episodes")
        text = f"{total - missing:,}/{total:,} episodes"
        return Outlook(next=following if missing else None, begun=missing < total, text=text)

    def done_count(self, step: str) -> int:
        """Episodes in the records."""
        return inventory.count_rows(self._file)

    @property
    def _file(self) -> Path:
        return inventory.player_file(self.results, self.player)


Job = RunJob | PlayerJob


def training_flags(run: TrainingRun, scale: float) -> tuple[str, ...]:
    """The flags of gvz.launch for this run, without --run-dir."""
    settings = _settings(run, scale)
    if run.variant is not None:
        settings["name"] = run.agent
    if run.max_processor_s is None:
        settings["checkpoint.period_updates"] = run.checkpoint_period_updates
    else:
        settings["max_processor_s"] = run.max_processor_s
    return ("--config", run.config, *settings_flags(settings))


def _settings(run: TrainingRun, scale: float) -> Settings:
    """What the plan sets of the run's config file."""
    return {
        "tasks": run.tasks,
        "seed": run.seed,
        "learner.total_updates": run.total_updates,
        **run.settings,
        **scaled_settings(run.run_config, run.total_updates, scale),
    }


def _episodes(evaluation: Evaluation) -> tuple[str, ...]:
    return ("--tasks", *evaluation.tasks, "--episodes", str(evaluation.episodes))
