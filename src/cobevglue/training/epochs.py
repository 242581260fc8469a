"""Loop over the epochs of a training run in one process, with logging, checkpoints and resuming."""

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
    """Run all remaining epochs.

    Args:
        config: settings of the run, stored in its files.
        folder: of the run; created if missing. The state is saved after each epoch.
        learner: model and optimiser.
        state: the result of `begin_run`.
        train: trains one epoch, given its index from 0.
        validate: returns metrics after the last epoch; empty without validation data.
        save: writes the weights after each epoch, given their metadata.

    Returns:
        The result of `validate`; empty if no epochs remained.

    Raises:
        DivergedError: the loss is not finite.
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
