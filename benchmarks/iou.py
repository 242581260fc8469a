"""Speed and exactness of the rotated IoU and NMS beside shapely: `python benchmarks/iou.py`.

Boxes are traffic-like: cars of about 4.5 x 1.9 m in lanes over 280 x 80 m, and detections of them (0.3 m, 3 degrees of
noise). Shapely gets its best known way: vectorised polygons, an STRtree for the candidates, vectorised intersections.
Both start from `Boxes` and return the whole (N, M) matrix.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import shapely

from cobevglue import Boxes
from cobevglue.iou import bev_iou, nms
from cobevglue.typing import FloatArray, IntArray
from common import print_head


def traffic(n: int, rng: np.random.Generator) -> Boxes:
    """`n` cars in the lanes of two crossing roads' directions, scored."""
    lane = rng.integers(-10, 11, n) * 3.5 + rng.normal(0.0, 0.3, n)
    center = np.column_stack([rng.uniform(-140.0, 140.0, n), np.clip(lane, -40, 40), np.full(n, -1.0)])
    size = np.column_stack([rng.normal(4.5, 0.4, n), rng.normal(1.9, 0.1, n), np.full(n, 1.6)])
    yaw = rng.choice([0.0, np.pi, np.pi / 2], n, p=[0.45, 0.45, 0.1]) + rng.normal(0.0, 0.05, n)
    return Boxes(center, size, yaw, score=rng.uniform(size=n))


def detected(boxes: Boxes, rng: np.random.Generator) -> Boxes:
    """The same cars as another detector might see them."""
    n = len(boxes)
    shift = np.column_stack([rng.normal(0.0, 0.3, (n, 2)), np.zeros(n)])
    return boxes.replace(center=boxes.center + shift, yaw=boxes.yaw + rng.normal(0.0, np.radians(3.0), n))


def shapely_iou(a: Boxes, b: Boxes) -> FloatArray:
    """`bev_iou` by shapely."""
    polygons_a, polygons_b = shapely.polygons(a.bev_corners()), shapely.polygons(b.bev_corners())
    i, j = shapely.STRtree(polygons_b).query(polygons_a, predicate="intersects")
    iou = np.zeros((len(a), len(b)))
    overlap = shapely.area(shapely.intersection(polygons_a[i], polygons_b[j]))
    area_a, area_b = a.size[:, 0] * a.size[:, 1], b.size[:, 0] * b.size[:, 1]
    iou[i, j] = overlap / (area_a[i] + area_b[j] - overlap)
    return iou


def shapely_nms(boxes: Boxes, iou_threshold: float) -> IntArray:
    """`nms` by shapely: the matrix once, then the greedy pass."""
    assert boxes.score is not None
    suppresses = shapely_iou(boxes, boxes) > iou_threshold
    dropped = np.zeros(len(boxes), dtype=bool)
    kept = []
    for row in np.argsort(-boxes.score, kind="stable"):
        if not dropped[row]:
            kept.append(row)
            dropped |= suppresses[row]
    return np.array(kept, dtype=np.int64)


def milliseconds(function: Callable[[], object], seconds: float = 1.0) -> float:
    """Median time of a call over about `seconds` (at least 5 calls), after one to warm up."""
    function()
    times: list[float] = []
    while sum(times) < seconds or len(times) < 5:
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    seed = parser.parse_args().seed
    print_head(f"seed {seed}", f"shapely {shapely.__version__}")
    print("| what | ours [ms] | shapely [ms] | ratio | largest difference | overlapping pairs |")
    print("|---|---|---|---|---|---|")
    for n in (40, 200, 1000):
        rng = np.random.default_rng([seed, n])
        a = traffic(n, rng)
        b = detected(a, rng)
        ours, theirs = milliseconds(partial(bev_iou, a, b)), milliseconds(partial(shapely_iou, a, b))
        iou = bev_iou(a, b)
        result = f"{np.abs(iou - shapely_iou(a, b)).max():.1e} | {(iou > 0).sum()}"
        print(f"| IoU {n} x {n} | {ours:.3f} | {theirs:.2f} | {theirs / ours:.1f} | {result} |")
    for n in (200, 1000):
        rng = np.random.default_rng([seed, n])
        cars = traffic(n // 5, rng)
        boxes = Boxes.concatenate([detected(cars, rng) for _ in range(5)]).replace(score=rng.uniform(size=n))
        ours, theirs = milliseconds(partial(nms, boxes, 0.15)), milliseconds(partial(shapely_nms, boxes, 0.15))
        kept = nms(boxes, 0.15)
        result = "same rows" if np.array_equal(kept, shapely_nms(boxes, 0.15)) else "OTHER rows"
        print(f"| NMS of {n}, {len(kept)} kept | {ours:.3f} | {theirs:.2f} | {theirs / ours:.1f} | {result} | |")


if __name__ == "__main__":
    main()
