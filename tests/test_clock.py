"""The clock of frames: steps in seconds, and other units are found."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from cobevglue.alignment import BEVGlue
from cobevglue.boxes import Boxes
from cobevglue.clock import Clock
from cobevglue.tracking import Sort

NOTHING = Boxes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


@pytest.mark.parametrize(
    ("time", "unit"),
    [(1.7e12, "milliseconds"), (1.7e15, "microseconds"), (1.7e18, "nanoseconds"), (-1.7e15, "microseconds")],
)
def test_stamps_since_1970_in_other_units_are_errors(time: float, unit: str) -> None:
    clock = Clock(0.1)
    with pytest.raises(ValueError, match=f"time must be in seconds: .* looks like {unit}"):
        clock.advance(time)
    assert clock.time is None, "it is as it was"
    with pytest.raises(ValueError, match=unit):
        Sort().update(NOTHING, time=time)
    with pytest.raises(ValueError, match=unit):
        BEVGlue().align(NOTHING, NOTHING, time=time)


@pytest.mark.parametrize("step", [0.0, 1e-310, 1e-11])
def test_steps_too_short_for_velocities_are_errors(step: float) -> None:
    clock = Clock(0.1)
    clock.advance(0.0)
    with pytest.raises(ValueError, match="time must be later"):
        clock.advance(step)
    assert clock.advance(1e-3) == 1e-3


def test_other_list_that_follows_at_once() -> None:
    """It is the last one again: over so short a time there is no velocity."""
    glue = BEVGlue()
    boxes = Boxes(np.eye(4, 3) * 9.0 + 1.0, np.full((4, 3), 2.0), np.zeros(4), track_id=np.arange(4))
    for k in range(4):
        glue.align(boxes, boxes, time=0.1 * k, other_time=1e-310 * k)


@pytest.mark.parametrize(("step", "unit"), [(100, "milliseconds"), (1e5, "microseconds"), (1e8, "nanoseconds")])
def test_stamps_since_boot_in_other_units_warn(step: float, unit: str) -> None:
    clock = Clock(0.1)
    for k in range(3):
        clock.advance(5000.0 + k * step)
    with pytest.warns(UserWarning, match=rf"time must be in seconds: .* {unit}\?"):
        clock.advance(5000.0 + 3 * step)


@pytest.mark.parametrize(
    ("times", "why"),
    [
        ([1.7e9, 1.7e9 + 0.1, 1.7e9 + 0.2, 1.7e9 + 0.3], "seconds since 1970"),
        ([0.0, 1e6, 2e6, 2e6 + 0.1, 3e6, 4e6], "pauses, never three in a row"),
    ],
)
def test_seconds_do_not_warn(times: list[float], why: str) -> None:
    clock = Clock(0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        steps = [clock.advance(time) for time in times]
    assert steps == [0.1, *np.diff(times)], why
