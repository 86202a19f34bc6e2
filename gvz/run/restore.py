"""What a run goes on from: its newest checkpoint, and its records cut back to it."""

import contextlib
import time
from collections.abc import Callable, Generator
from typing import Any

from gvz.core.durable import saved_steps
from gvz.core.errors import CheckpointError, GvzError
from gvz.run import machine
from gvz.run.group import Group
from gvz.run.rundir import START_RECORDS, RunDir
from gvz.segmentation import KEPT_SEGMENTERS, kept_digests
from learner.checkpoint import Restored, restore_newest


def restore(run: RunDir, template: Any, group: Group, say: Callable[[str], None]) -> Restored | None:
    """Reads the newest whole checkpoint that all processes of the run have; None for a new run.

    Raises:
        CheckpointError: there are checkpoints, but none that can be used; or the disk of a link is not mounted.
    """
    restored = group.restored(lambda newest: restore_newest(run.checkpoints, template, newest))
    for folder, without in ((run.checkpoints, "begin a new run"), (run.path / "policies", "go on without what it had")):
        if folder.is_symlink() and not folder.exists():
            raise CheckpointError(
                f"{folder}: leads to {folder.readlink()}, which is not there; mount its disk, or remove the link to "
                f"{without}"
            )
    if restored is None:
        if len(steps := saved_steps(run.checkpoints)) > 1:
            raise CheckpointError(
                f"{run.checkpoints}: there are checkpoints of updates {steps}, but another learner process has none of "
                "these; bring its run directory back, or give all another --run-dir"
            )
        say(f"new run in {run.path}")
        run.discard_after(0)
        run.truncate_records(dict.fromkeys(run.record_lengths(), 0))
        return None
    for damage in restored.damage:
        say(f"damaged checkpoint passed over: {damage}")
    say(f"run in {run.path} goes on from update {restored.num_updates}")
    return restored


def note_start(run: RunDir, restored: Restored | None) -> None:
    """Adds a row of this start to the records: from which update, when, and on what machine."""
    num_updates = 0 if restored is None else restored.num_updates
    networks = {"segmenters": found} if (found := kept_digests(run.path / KEPT_SEGMENTERS)) else {}
    run.append(START_RECORDS, {"num_updates": num_updates, "time_s": time.time(), **machine.describe(), **networks})


@contextlib.contextmanager
def state_checked(run: RunDir, restored: Restored | None) -> Generator[None]:
    """Cuts records, policies and checkpoints back; within it, a host state that no run can go on from is named.

    Raises:
        CheckpointError: the checkpoint's host state is not one of a run.
    """
    try:
        if restored is not None:
            run.discard_after(restored.num_updates)  # first: where it is refused, a later start may read a newer one
            run.truncate_records(restored.host["records"])
        yield
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if restored is None or isinstance(error, GvzError):
            raise
        raise CheckpointError(
            f"{run.checkpoints / str(restored.num_updates)}: its host state is not one of a run ({error!r}); move it "
            "aside, and the run goes on from the checkpoint before it"
        ) from error
