"""A run whose policy has the parameters of the last gradient step, from one that evaluates their moving average.

    python -m benchmarks.last_parameters runs/NAME/seed_1111 runs/NAME_last/seed_1111
    gvz evaluate runs/NAME_last/seed_1111 --split gate

An average (`learner.average_ema`) changes evaluation alone, so the two compare what it gives within one training run.
"""

import contextlib
import dataclasses
import shutil
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import tyro

from gvz.core.durable import saved_steps
from gvz.core.errors import CheckpointError, ConfigError, GvzError
from gvz.evaluation.trained import read_run_config
from gvz.run.assemble import assemble
from gvz.run.rundir import RunDir
from gvz.segmentation import KEPT_SEGMENTERS
from learner import checkpoint


def write_last_parameters(run_dir: Path, out: Path) -> int:
    """Writes a run directory with the policy of the run's newest whole checkpoint; returns its gradient steps.

    Args:
        run_dir: a run that keeps an average.
        out: a directory that is not there yet.

    Raises:
        ConfigError: there is no such run, it keeps no average, or `out` is there. CheckpointError: damaged, or none.
    """
    config = read_run_config(run_dir)
    if config.learner.average_ema is None:
        raise ConfigError(
            f"{run_dir}: its policies have the last parameters: it keeps no average (learner.average_ema)"
        )
    if out.exists():
        raise ConfigError(f"{out} is already there; name a new directory")
    with tempfile.TemporaryDirectory() as work:
        parts = assemble(config, Path(work))
    acting = jax.ShapeDtypeStruct((parts.pool_config.num_params,), jnp.float32)
    template = {**parts.learner.array_shapes(), "acting": acting}
    checkpoints = run_dir / "checkpoints"
    if not (steps := saved_steps(checkpoints)):
        raise CheckpointError(f"{checkpoints}: holds no whole checkpoint")
    arrays, _ = checkpoint.read(checkpoints / str(steps[-1]), template)
    with contextlib.closing(RunDir(out)) as made:
        if (run_dir / KEPT_SEGMENTERS).exists():
            shutil.copytree(run_dir / KEPT_SEGMENTERS, out / KEPT_SEGMENTERS)
        made.write_config(dataclasses.replace(config, name=f"{config.name}+last_parameters", run_dir=None))
        policy = out / "policies" / str(steps[-1])
        checkpoint.write(policy, arrays["learner"].params, {"num_updates": steps[-1]})
    return steps[-1]


def main(run_dir: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path]) -> int:
    """Write a run directory whose policy has the parameters of the run's last gradient step.

    Args:
        run_dir: directory of a run with learner.average_ema.
        out: the new directory.
    """
    try:
        num_updates = write_last_parameters(run_dir, out)
    except GvzError as error:
        print(f"last_parameters: {error}", file=sys.stderr)
        return 2
    print(f"{out}: the parameters after {num_updates:,} gradient steps; play with gvz evaluate {out}")
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
