"""What a run says about itself: lines for people, `log.jsonl` for programs, event files for TensorBoard."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import torch

__all__ = ["Meter", "RunLog", "duration", "print_progress"]


def print_progress(text: str) -> None:
    """A line to standard error."""
    print(text, file=sys.stderr, flush=True)


class RunLog:
    """Files of one run, added to when it is resumed. Without TensorBoard there is `log.jsonl` alone."""

    def __init__(self, folder: Path, from_step: int = 0, write: bool = True) -> None:
        """Open the files.

        Args:
            folder: of the run.
            from_step: where a resumed run goes on: what an earlier try logged beyond is forgotten. 0 starts anew.
            write: False for a log of nothing: one process writes for all.
        """
        self._lines: TextIO | None = None
        self._events: Any = None
        if not write:
            return
        path = folder / "log.jsonl"
        kept = [line for line in _complete_lines(path) if json.loads(line)["step"] <= from_step]
        self._lines = path.open("w", encoding="utf-8")
        self._lines.writelines(kept if from_step else [])
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        self._events = SummaryWriter(str(folder), purge_step=from_step or None)

    def __enter__(self) -> RunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._lines is not None:
            self._lines.close()
        if self._events is not None:
            self._events.close()

    def add(self, group: str, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Log numbers after `step` steps: a line in `log.jsonl`, a curve "group/name" each in TensorBoard."""
        if self._lines is None:
            return
        finite = {name: value if math.isfinite(value) else None for name, value in values.items()}
        entry = {"group": group, "step": step, "epoch": epoch, "time": round(time.time(), 3), **finite}
        self._lines.write(json.dumps(entry) + "\n")
        self._lines.flush()
        if self._events is not None:
            for name, value in values.items():
                self._events.add_scalar(f"{group}/{name}", value, step)


def _complete_lines(path: Path) -> list[str]:
    """Those of an earlier try; one that was cut off while writing is left out."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.is_file() else []
    return [line for line in lines if line.endswith("}\n")]


@dataclass
class Meter:
    """Means over steps. Sums stay on the device: asking a GPU for a number makes it wait."""

    started: float = field(default_factory=time.monotonic)
    sums: dict[str, torch.Tensor] = field(default_factory=dict)
    steps: int = 0
    samples: int = 0
    waited: float = 0.0

    def add(self, values: Mapping[str, torch.Tensor], samples: int, waited: float) -> None:
        """The values of a step, its samples, and the time it waited for them [s]."""
        for name, value in values.items():
            self.sums[name] = self.sums[name] + value if name in self.sums else value
        self.steps, self.samples, self.waited = self.steps + 1, self.samples + samples, self.waited + waited

    @property
    def seconds(self) -> float:
        """Since the first."""
        return time.monotonic() - self.started

    def means(self) -> dict[str, float]:
        """Of the values, with "samples_per_second" and the share of time spent "waiting"."""
        seconds = max(self.seconds, 1e-9)
        terms = {name: float(value) / self.steps for name, value in self.sums.items()}
        return {**terms, "samples_per_second": self.samples / seconds, "waiting": self.waited / seconds}


def duration(seconds: float) -> str:
    """In words: "5 min", "1 h 20 min"."""
    minutes = round(seconds / 60.0)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"
