"""The time of successive frames, and a check that it is in seconds."""

from __future__ import annotations

import math
import warnings

__all__ = ["SHORTEST_STEP", "Clock"]

_LATEST = 1e11
"""Times from here on are in no unit of seconds: since 1970, this is the year 5138 [s]."""
SHORTEST_STEP = 1e-10
"""Two times that differ by less, a tenth of a nanosecond, are one [s]."""
_LONG_STEP = 20.0
"""A step between frames that is implausible if it comes again and again: 20 ms in milliseconds [s]."""
_LONG_STEPS = 3
"""So many long steps in a row are no pauses."""


class Clock:
    """Steps from frame to frame, of times in seconds on any clock.

    Args:
        period: time between frames that come without a time [s].

    Attributes:
        time: of the last frame [s]; None before the first.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self.reset()

    def reset(self) -> None:
        """The next frame is the first one."""
        self.time: float | None = None
        self._long_steps = 0

    def advance(self, time: float | None) -> float:
        """The step to the next frame [s]; `period` for the first one. Warns where three steps in a row are over 20 s.

        Args:
            time: of the next frame [s]; by default `period` after the last.

        Raises:
            ValueError: `time` is not finite, not later than the last one, or too large to be in seconds; the clock is
                then as it was.
        """
        last = self.time
        if time is None:
            time = 0.0 if last is None else last + self._period
        time = float(time)
        if not math.isfinite(time):
            raise ValueError(f"time must be finite, got {time}")
        if abs(time) >= _LATEST:
            raise ValueError(f"time must be in seconds: {time:.6g} looks like {_unit(abs(time) / _LATEST)}")
        if last is not None and time - last < SHORTEST_STEP:
            raise ValueError(f"time must be later than the last one, {last} s, got {time} s (reset() starts anew)")
        self.time = time
        if last is None:
            return self._period
        step = time - last
        self._long_steps = self._long_steps + 1 if step >= _LONG_STEP else 0
        if self._long_steps == _LONG_STEPS:
            warnings.warn(
                f"time must be in seconds: the last {_LONG_STEPS} steps are {_LONG_STEP:g} s or more (now {step:.6g}) "
                f"and nothing is remembered for so long: are these {_unit(step / _LONG_STEP)}?",
                stacklevel=3,
            )
        return step


def _unit(ratio: float) -> str:
    """The unit of a number that is so many times as large as the largest plausible one in seconds."""
    return "milliseconds" if ratio < 1e3 else "microseconds" if ratio < 1e6 else "nanoseconds"
