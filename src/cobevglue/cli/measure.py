"""Run time of tracking, messages and alignment on synthetic frames with given numbers of objects."""

from __future__ import annotations

import gc
import math
import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from cobevglue.alignment import BEVGlue, BEVGlueConfig
from cobevglue.boxes import Boxes
from cobevglue.messages import ObjectMessage, decode, encode
from cobevglue.se2 import SE2
from cobevglue.tracking import Sort

__all__ = ["OBJECT_COUNTS", "STEPS", "measure", "processor_name"]

OBJECT_COUNTS = (5, 15, 40, 100, 200)
TRACK, ENCODE, DECODE = "track", "encode", "decode"
FIRST, LATER = "BEVGlue, first frame", "BEVGlue, later frames"
PAPER_FIRST, PAPER_LATER = "paper's settings, first frame", "paper's settings, later frames"
STEPS = (TRACK, ENCODE, DECODE, FIRST, LATER, PAPER_FIRST, PAPER_LATER)
"""Timed steps: one tracker update, one message, and one alignment without and with previous frames."""

_FRAMES = 25  # per sequence
_WARM_UP = 5  # first frames of a sequence, not timed
_SECONDS_AT_MOST = 2.0  # per step and object count; limits the number of timed frames, at least one
_PAPER_OBJECTS_AT_MOST = 100  # with the paper's settings, more objects take minutes
_SHARED = 0.6  # share of the objects that both agents observe
_AREA_PER_OBJECT = 250.0  # [m^2], for a constant density of traffic
_SEED = 0


def measure(progress: Callable[[int], None]) -> dict[str, Any]:
    """Measure every step for every number of objects in `OBJECT_COUNTS`.

    Args:
        progress: is called with each number of objects before its measurement.

    Returns:
        JSON-serialisable: `steps[step][count]` with `median_ms`, `best_ms` and `repeats`, or None for omitted slow
        combinations; `message_bytes[count]`; machine and versions.
    """
    steps: dict[str, dict[str, Any]] = {step: {} for step in STEPS}
    message_bytes = {}
    _run(OBJECT_COUNTS[0], _WARM_UP + 1)  # compile, or load from the cache
    for count in OBJECT_COUNTS:
        progress(count)
        taken, message_bytes[str(count)] = _run(count, _FRAMES)
        for step in STEPS:
            steps[step][str(count)] = _statistics(taken[step]) if step in taken else None
    packages = ("cobevglue", "numpy", "numba", "scipy")
    return {
        "steps": steps,
        "message_bytes": message_bytes,
        "machine": {"processor": processor_name(), "cores": os.cpu_count(), "system": platform.system()},
        "versions": {"python": platform.python_version(), **{name: version(name) for name in packages}},
    }


def _statistics(seconds: list[float]) -> dict[str, float | int]:
    return {"median_ms": 1e3 * statistics.median(seconds), "best_ms": 1e3 * min(seconds), "repeats": len(seconds)}


def _run(count: int, frames: int) -> tuple[dict[str, list[float]], int]:
    """Run times of each step in the frames of a sequence [s], and the length of a message [bytes]."""
    scene = [_scene(count, index) for index in range(frames)]
    ego_tracker, other_tracker, timed_tracker = Sort(), Sort(), Sort()
    tracked = [(ego_tracker.update(ego), other_tracker.update(other)) for ego, other in scene]
    messages = [ObjectMessage("car2", 0.1 * index, index, other) for index, (_, other) in enumerate(tracked)]
    encoded = [encode(message) for message in messages]
    taken = {
        TRACK: _times(timed_tracker.update, [(ego,) for ego, _ in scene], _WARM_UP),
        ENCODE: _times(encode, [(message,) for message in messages], _WARM_UP),
        DECODE: _times(decode, [(data,) for data in encoded], _WARM_UP),
        FIRST: _times(BEVGlue().align, tracked, forget=True),
        LATER: _times(BEVGlue().align, tracked, _WARM_UP),
    }
    if count <= _PAPER_OBJECTS_AT_MOST:
        paper = BEVGlueConfig.paper()
        taken[PAPER_FIRST] = _times(BEVGlue(paper).align, tracked, forget=True)
        taken[PAPER_LATER] = _times(BEVGlue(paper).align, tracked, _WARM_UP)
    return taken, len(encoded[0])


def _times(
    step: Callable[..., object], inputs: Sequence[tuple[Any, ...]], skip: int = 0, *, forget: bool = False
) -> list[float]:
    """Run times of successive calls [s], up to a total of `_SECONDS_AT_MOST`.

    Args:
        step: function or bound method to call.
        inputs: arguments of each call.
        skip: number of first calls that are not timed.
        forget: call `reset()` of the object that `step` is bound to before each call.
    """
    seconds: list[float] = []
    collects = gc.isenabled()
    gc.disable()
    try:
        for number, arguments in enumerate(inputs):
            if forget:
                step.__self__.reset()  # type: ignore[attr-defined]
            start = time.perf_counter()
            step(*arguments)
            if number >= skip:
                seconds.append(time.perf_counter() - start)
            if sum(seconds) > _SECONDS_AT_MOST:
                break
    finally:
        if collects:
            gc.enable()
    return seconds


def _scene(count: int, index: int) -> tuple[Boxes, Boxes]:
    """Detections of two agents in frame `index` of a scene of parked cars: `count` boxes each, 60 % in common."""
    world = np.random.default_rng([_SEED, count])
    shared = round(_SHARED * count)
    total = 2 * count - shared
    side = math.sqrt(_AREA_PER_OBJECT * total)
    cars = Boxes(
        center=np.column_stack([world.uniform(-side / 2, side / 2, (total, 2)), np.zeros(total)]),
        size=[4.5, 1.9, 1.6] + world.normal(0.0, [0.3, 0.08, 0.1], (total, 3)),
        yaw=world.uniform(-math.pi, math.pi, total),
    )
    noise = np.random.default_rng([_SEED, count, index + 1])
    other_SE2_ego = SE2(12.0, -8.0, 2.0)
    mine, theirs = cars[:count], cars[total - count :].transform(other_SE2_ego)
    return _detected(mine, noise), _detected(theirs, noise)


def _detected(boxes: Boxes, rng: np.random.Generator) -> Boxes:
    """Boxes with detection noise, in random order."""
    n = len(boxes)
    noisy = boxes.replace(
        center=boxes.center + rng.normal(0.0, 0.2, (n, 3)), yaw=boxes.yaw + rng.normal(0.0, math.radians(2.0), n)
    )
    return noisy[rng.permutation(n)]


def processor_name() -> str:
    """Name of the processor, as reported by the system."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
