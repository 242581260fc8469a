"""Time of one alignment over the number of boxes, beside a plain NumPy star search in the same run.

    python benchmarks/matching_speed.py

One core; the calls include everything that Python does around the kernels. *First* is a call on a fresh BEVGlue,
*following* one that also carries hypotheses from the frame before. The star search is the paper's matcher in NumPy
(`BEVGlueConfig.paper()`, first frame: all pairs seed), vectorised over the pairs that may join a star. Scenes are
seeded: boxes spread like traffic, two thirds of them common, 0.3 m and 3 degrees of noise.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np

from cobevglue import SE2, BEVGlue, BEVGlueConfig, Boxes
from cobevglue.typing import FloatArray
from common import print_head

COUNTS = (5, 15, 40, 100, 200)
STAR_SEARCH_UP_TO = 40
"""The star search needs seconds to minutes beyond this."""


def main() -> None:
    """Print the table."""
    print_head("seed 0")
    print("milliseconds, fastest | median\n")
    print("| boxes each | first | following | NumPy star search | ratio of the medians, first |\n|" + " --- |" * 5)
    for count in COUNTS:
        ego, other = scene(count, seed=0)
        fresh, carried = BEVGlue(), BEVGlue()
        carried.align(ego, other)

        def first(glue: BEVGlue = fresh, ego: Boxes = ego, other: Boxes = other) -> None:
            glue.reset()
            glue.align(ego, other)

        def following(glue: BEVGlue = carried, ego: Boxes = ego, other: Boxes = other) -> None:
            glue.align(ego, other)

        def star_search(ego: Boxes = ego, other: Boxes = other) -> None:
            BEVGlue(BEVGlueConfig.paper()).align(ego, other)

        ours = timed(first, 200)
        row = [str(count), show(ours), show(timed(following, 200))]
        if count <= STAR_SEARCH_UP_TO:
            theirs = timed(star_search, 5)
            row += [show(theirs), f"{np.median(theirs) / np.median(ours):.0f}"]
        else:
            row += ["", ""]
        print("| " + " | ".join(row) + " |", flush=True)


def scene(count: int, seed: int) -> tuple[Boxes, Boxes]:
    """Two lists of `count` boxes of which two thirds are common, in two frames."""
    rng = np.random.default_rng([seed, count])
    reach = 12.0 * math.sqrt(count) + 20.0
    center = np.column_stack([rng.uniform(-reach, reach, (count, 2)), np.zeros(count)])
    size = np.column_stack([rng.normal(4.5, 0.4, count), rng.normal(1.9, 0.1, count), np.full(count, 1.6)])
    yaw = rng.choice([0.0, 0.5, 1.0, 1.5], count) * math.pi + rng.normal(0.0, 0.05, count)
    ego = Boxes(center, size, yaw, track_id=np.arange(count))
    seen = ego.transform(SE2(10.0, 5.0, 1.0).inverse())[rng.permutation(count)]
    moved = seen.center + np.column_stack([rng.normal(0.0, 0.3, (count, 2)), np.zeros(count)])
    moved[: count // 3, :2] = rng.uniform(-reach, reach, (count // 3, 2))
    return ego, seen.replace(center=moved, yaw=seen.yaw + rng.normal(0.0, math.radians(3.0), count))


def timed(call: Callable[[], None], repeats: int) -> FloatArray:
    """Milliseconds of each repeat, after one that does not count."""
    call()
    times = np.empty(repeats)
    for i in range(repeats):
        start = time.perf_counter()
        call()
        times[i] = 1e3 * (time.perf_counter() - start)
    return times


def show(times: FloatArray) -> str:
    """Fastest and median."""
    return f"{times.min():.3f} | {np.median(times):.3f}".replace(" | ", " \\| ")


if __name__ == "__main__":
    main()
