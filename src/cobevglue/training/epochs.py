"""The epochs of a training in one process: logged, timed, saved after each, and continued where they were left."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path

from cobevglue.settings import Settings
from cobevglue.training.checkpoint import STATE, RunState, provenance, save_state
from cobevglue.training.optimisation import Learner, Model
from cobevglue.training.run_log import RunLog

__all__ = ["run_epochs"]


def run_epochs(
    config: Settings,
    folder: Path,
    learner: Learner[Model],
    state: RunState | None,
    *,
    train: Callable[[int, RunLog], None],
    validate: Callable[[], dict[str, float]],
    save: Callable[[dict[str, object]], None],
) -> dict[str, float]:
    """Run all epochs that are left.

    Args:
        config: settings of the run, for its files.
        folder: of the run; made where missing. Its state is saved after each epoch.
        learner: what is trained.
        state: what `begin_run` returned.
        train: trains one epoch, given its number from 0.
        validate: measures after the last epoch; empty where there is nothing to measure on.
        save: writes the weights after each epoch, given their metadata.

    Returns:
        What `validate` measured; empty if no epoch was left.

    Raises:
        DivergedError: the loss is not finite any more.
    """
    first, elapsed = (0, 0.0) if state is None else (state.epoch, state.elapsed)
    epochs, steps = learner.config.epochs, learner.config.steps_per_epoch()
    metrics: dict[str, float] = {}
    folder.mkdir(parents=True, exist_ok=True)
    with RunLog(folder, first * steps) as log:
        for done in range(first + 1, epochs + 1):
            started = time.monotonic()
            train(done - 1, log)
            if done == epochs and (metrics := validate()):
                log.add("validation", done * steps, done, metrics)
            elapsed += time.monotonic() - started
            known = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
            training = config.model_dump(mode="json")
            save({**provenance(), "training": training, "epoch": done, "seconds": round(elapsed), "metrics": known})
            save_state(folder / STATE, learner.state(config, done, elapsed))
    return metrics
