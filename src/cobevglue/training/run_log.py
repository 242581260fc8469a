"""Log of a run: progress messages, `log.jsonl`, and event files of TensorBoard."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

__all__ = ["RunLog", "print_progress"]


def print_progress(text: str) -> None:
    """Print a line to standard error."""
    print(text, file=sys.stderr, flush=True)


class RunLog:
    """Log files of one run, appended to when it is resumed. Without TensorBoard, only `log.jsonl` is written."""

    def __init__(self, folder: Path, from_step: int = 0, write: bool = True) -> None:
        """Open the files.

        Args:
            folder: of the run.
            from_step: step at which a run is resumed; later entries are removed. 0 removes all entries.
            write: False disables the log, in all but the first process.
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
        """Log values after `step` steps: one line in `log.jsonl`, and "group/name" in TensorBoard."""
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
    """Lines of an existing log, without one that was written incompletely."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.is_file() else []
    return [line for line in lines if line.endswith("}\n")]
