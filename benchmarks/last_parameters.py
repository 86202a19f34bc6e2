"""A run whose policy has the parameters of the last gradient step, from one that evaluates their moving average.

    python -m benchmarks.last_parameters runs/NAME/seed_1111 runs/NAME_last/seed_1111
    gvz evaluate runs/NAME_last/seed_1111 --split gate

An average (`learner.average_ema`) changes evaluation alone, so the two compare what it gives within one training run.
"""

import dataclasses
import json
import shutil
import sys
from pathlib import Path
from typing import Annotated

import tyro

from gvz.core.errors import ConfigError, GvzError
from gvz.core.registry import NO_OWN_FILES, OwnFiles
from gvz.evaluation.trained import find_checkpoint, read_run_config
from gvz.run.assemble import assemble
from gvz.run.config_files import config_from_dict
from gvz.run.rundir import RunDir, disk_checked
from gvz.segmentation import KEPT_SEGMENTERS
from learner import checkpoint


def write_last_parameters(run_dir: Path, out: Path, own_files: OwnFiles = NO_OWN_FILES) -> int:
    """Writes a run directory with the last parameters of the run's newest policy; returns its gradient steps.

    Args:
        run_dir: a run that keeps an average.
        out: a directory that is not there yet. If writing fails, it is removed.
        own_files: as for `read_run_config`.

    Raises:
        ConfigError: there is no such run or policy, it keeps no average, or `out` is there.
        CheckpointError: the whole checkpoint of that policy is missing or damaged.
        ResumeError: the disk does not take it.
    """
    config = read_run_config(run_dir, own_files)
    if config.learner.average_ema is None:
        raise ConfigError(
            f"{run_dir}: its policies have the last parameters: it keeps no average (learner.average_ema)"
        )
    if out.exists():
        raise ConfigError(f"{out} is already there; name a new directory")
    template = assemble(config, Path()).array_shapes()
    num_updates = find_checkpoint(run_dir, "newest")
    arrays, _ = checkpoint.read(run_dir / "checkpoints" / str(num_updates), template)
    try:
        with disk_checked(out), RunDir(out) as made:
            if (run_dir / KEPT_SEGMENTERS).exists():
                shutil.copytree(run_dir / KEPT_SEGMENTERS, out / KEPT_SEGMENTERS)
            saved = config_from_dict(json.loads((run_dir / "config.json").read_text()), own_files)
            made.write_config(dataclasses.replace(saved, name=f"{saved.name}+last_parameters", run_dir=None))
            policy = out / "policies" / str(num_updates)
            checkpoint.write(policy, arrays["learner"].params, {"num_updates": num_updates})
    except BaseException:
        shutil.rmtree(out, ignore_errors=True)
        raise
    return num_updates


def main(
    run_dir: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    own_files: Annotated[OwnFiles, tyro.conf.arg(name="")] = NO_OWN_FILES,
) -> int:
    """Write a run directory whose policy has the parameters of the run's last gradient step.

    Args:
        run_dir: directory of a run with learner.average_ema.
        out: the new directory.
        own_files: as for `gvz evaluate`.
    """
    try:
        num_updates = write_last_parameters(run_dir, out, own_files)
    except GvzError as error:
        print(f"last_parameters: {error}", file=sys.stderr)
        return 2
    print(f"{out}: the parameters after {num_updates:,} gradient steps; play with gvz evaluate {out}")
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
