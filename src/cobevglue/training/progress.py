"""Progress of an epoch: means of loss terms, speed, remaining time; detects divergence."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from torch import Tensor

from cobevglue.training.optimisation import OptimisationConfig
from cobevglue.training.run_log import RunLog

__all__ = ["DivergedError", "EpochProgress"]


class DivergedError(RuntimeError):
    """The loss is not finite."""


class EpochProgress:
    """Logs and reports means over steps, periodically and at the end of the epoch."""

    def __init__(
        self,
        optimisation: OptimisationConfig,
        epoch: int,
        log: RunLog,
        report: Callable[[str], None],
        *,
        every: float,
        processes: int = 1,
        name: str = "",
    ) -> None:
        """Start an epoch.

        Args:
            optimisation: settings, for the number of steps.
            epoch: index from 0.
            log: of the run; group "train" every `every` seconds, group "epoch" at the end.
            report: is called with each line of progress.
            every: time between reports [s].
            processes: number of processes that train together.
            name: prefix of the reported lines.
        """
        self._optimisation, self._log, self._report, self._every = optimisation, log, report, every
        self._batch = optimisation.batch_size * processes
        self._per_epoch = optimisation.steps_per_epoch(processes)
        self._epoch, self._head = epoch, f"{name}: " if name else ""
        self._step = epoch * self._per_epoch
        self._whole, self._recent = _Meter(), _Meter()

    @property
    def steps(self) -> range:
        """Indices of the steps of this epoch, counted over all epochs from 0."""
        return range(self._epoch * self._per_epoch, (self._epoch + 1) * self._per_epoch)

    @property
    def all_steps(self) -> int:
        """Number of steps of all epochs."""
        return self._optimisation.epochs * self._per_epoch

    def add(self, values: Mapping[str, Tensor], rate: float, waited: float = 0.0) -> None:
        """Add a completed step.

        Args:
            values: scalars of the step; "total" is the loss.
            rate: the learning rate.
            waited: time spent waiting for samples [s].

        Raises:
            DivergedError: the mean loss is not finite; checked only when it is reported.
        """
        self._step += 1
        detached = {name: value.detach() for name, value in values.items()}
        for meter in (self._whole, self._recent):
            meter.add(detached, self._batch, waited)
        if self._step == self.steps.stop:
            self._say("epoch", self._whole, rate)
        elif self._recent.seconds >= self._every:
            self._say("train", self._recent, rate)
            self._recent = _Meter()

    def _say(self, group: str, meter: _Meter, rate: float) -> None:
        numbers = meter.means()
        if not math.isfinite(numbers["total"]):
            raise DivergedError(
                f"the loss is {numbers['total']} at step {self._step}; the state of epoch {self._epoch} is kept. Lower "
                f"optimisation.learning_rate or optimisation.clip"
            )
        self._log.add(group, self._step, self._epoch, {**numbers, "learning_rate": rate})
        speed, waiting = numbers.pop("samples_per_second"), numbers.pop("waiting")
        left = (self.all_steps - self._step) * self._batch / speed
        self._report(
            f"{self._head}epoch {self._epoch + 1}/{self._optimisation.epochs} step {self._step}/{self.all_steps}: "
            + " ".join(f"{name} {value:.3f}" for name, value in numbers.items())
            + f", lr {rate:.1e}, {speed:.1f} samples/s ({100 * waiting:.0f} % waiting for data), {_duration(left)} left"
        )


@dataclass
class _Meter:
    """Means over steps. The sums stay on the device: reading a value synchronises with the GPU."""

    started: float = field(default_factory=time.monotonic)
    sums: dict[str, Tensor] = field(default_factory=dict)
    steps: int = 0
    samples: int = 0
    waited: float = 0.0

    def add(self, values: Mapping[str, Tensor], samples: int, waited: float) -> None:
        """Add the values of a step, its number of samples, and the time spent waiting for them [s]."""
        for name, value in values.items():
            self.sums[name] = self.sums[name] + value if name in self.sums else value
        self.steps, self.samples, self.waited = self.steps + 1, self.samples + samples, self.waited + waited

    @property
    def seconds(self) -> float:
        """Time since the start [s]."""
        return time.monotonic() - self.started

    def means(self) -> dict[str, float]:
        """Means of the values, "samples_per_second", and the share of time spent "waiting" for samples."""
        seconds = max(self.seconds, 1e-9)
        terms = {name: float(value) / self.steps for name, value in self.sums.items()}
        return {**terms, "samples_per_second": self.samples / seconds, "waiting": self.waited / seconds}


def _duration(seconds: float) -> str:
    """Format a duration: "5 min", "1 h 20 min"."""
    minutes = round(seconds / 60.0)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"
