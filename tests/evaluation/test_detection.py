"""Measures of detection: AP worked out by hand, an independent slow oracle, and what is ignored."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence

import numpy as np
import pytest
import shapely

from cobevglue.boxes import Boxes
from cobevglue.evaluation.detection import DetectionFrame, average_precision, evaluate_detections
from cobevglue.evaluation.detection_matching import DROPPED, FALSE, find_failures, match, prepare

A, B, C = (10.0, 0.0), (20.0, 0.0), (40.0, 0.0)
"""Places of cars, too far apart to overlap."""
NOWHERE = (0.0, 25.0)
"""A place without a car."""


def cars(
    *places: tuple[float, float], score: Sequence[float] | None = None, yaw: float = 0.0, label: str | None = None
) -> Boxes:
    """Cars of 4 m x 2 m at these places."""
    n = len(places)
    center = [(x, y, 0.0) for x, y in places]
    return Boxes(center, [(4.0, 2.0, 1.5)] * n, [yaw] * n, score=score, label=None if label is None else [label] * n)


def frame(truth: Sequence[tuple[float, float]], *detections: tuple[tuple[float, float], float]) -> DetectionFrame:
    """Cars at these places, and detections as (place, score)."""
    return DetectionFrame(cars(*(p for p, _ in detections), score=[s for _, s in detections]), cars(*truth))


@pytest.mark.parametrize(
    ("frames", "overall", "frame_order"),
    [
        # everything is found and nothing else
        ([frame([A, B], (A, 0.9), (B, 0.8))], 1.0, 1.0),
        # everything is wrong
        ([frame([A, B], (NOWHERE, 0.9))], 0.0, 0.0),
        # nothing is detected
        ([frame([A, B])], 0.0, 0.0),
        # one of two is missed: precision 1 up to recall 1/2, then nothing
        ([frame([A, B], (A, 0.9))], 0.5, 0.5),
        # a duplicate scored between the two: precision 1, 1/2, 2/3 at recall 1/2, 1/2, 1
        ([frame([A, B], (A, 0.9), (A, 0.8), (B, 0.7))], 0.5 * 1 + 0.5 * 2 / 3, 0.5 * 1 + 0.5 * 2 / 3),
        # a duplicate scored last does no harm
        ([frame([A, B], (A, 0.9), (B, 0.8), (A, 0.7))], 1.0, 1.0),
        # a false detection scored best: precision 0, 1/2, 2/3; the envelope is 2/3 everywhere
        ([frame([A, B], (NOWHERE, 0.9), (A, 0.8), (B, 0.7))], 2 / 3, 2 / 3),
        # a poor false detection in the first frame: last over the split, but before the second frame in frame order,
        # where precision is 1, 1/2, 2/3 as above
        ([frame([A], (A, 0.9), (NOWHERE, 0.1)), frame([B], (B, 0.8))], 1.0, 0.5 * 1 + 0.5 * 2 / 3),
        # the other way round it flatters: a sure false detection of the last frame is the first of the split
        ([frame([A], (A, 0.5)), frame([B], (NOWHERE, 0.9), (B, 0.4))], 2 / 3, 0.5 * 1 + 0.5 * 2 / 3),
        # a false detection in a frame without objects counts as any other
        ([frame([], (NOWHERE, 0.9)), frame([A], (A, 0.8))], 0.5, 0.5),
        # frames with nothing at all change nothing
        ([frame([]), frame([A], (A, 0.8)), frame([])], 1.0, 1.0),
        # no objects anywhere: not defined
        ([frame([], (NOWHERE, 0.9))], math.nan, math.nan),
        ([], math.nan, math.nan),
        # equal scores go by the order of frames and rows: first true, then false
        ([frame([A, B], (A, 0.5), (NOWHERE, 0.5)), frame([])], 0.5, 0.5),
        # and first false, then true
        ([frame([A, B], (NOWHERE, 0.5), (A, 0.5)), frame([])], 0.25, 0.25),
    ],
)
def test_average_precision_by_hand(frames: list[DetectionFrame], overall: float, frame_order: float) -> None:
    report = evaluate_detections(frames)
    for threshold in (0.3, 0.5, 0.7):  # detections are either exact or far off
        assert report.ap(threshold) == pytest.approx(overall, nan_ok=True)
        assert report.ap(threshold, "frame-order") == pytest.approx(frame_order, nan_ok=True)


def test_a_curve_by_hand() -> None:
    # Precision 1, 1/2, 1/3, 1/2, 3/5 of four objects: the envelope is 1, 3/5, 3/5 at the three true ones.
    assert average_precision(np.array([True, False, False, True, True]), 4) == pytest.approx((1 + 0.6 + 0.6) / 4)


@pytest.mark.parametrize(
    ("truth", "detections", "found"),
    [
        # an IoU of about 0.6 is enough, one of 0.43 is not
        ([A], [((11.0, 0.0), 0.9)], [0]),
        ([A], [((11.6, 0.0), 0.9)], [FALSE]),
        # the best score takes the object, not the best overlap
        ([A], [((11.0, 0.0), 0.9), (A, 0.8)], [0, FALSE]),
        # a detection between two objects takes the one it overlaps more
        ([A, (11.0, 0.0)], [((10.8, 0.0), 0.9)], [1]),
        # the second of two takes what is left, if it overlaps that enough
        ([A, (11.0, 0.0)], [((10.8, 0.0), 0.9), ((10.9, 0.0), 0.8)], [1, 0]),
        # an object that a detection did not overlap enough stays free
        ([A], [((11.6, 0.0), 0.9), (A, 0.8)], [FALSE, 0]),
        # rows are those of the scores' order
        ([A, B], [(A, 0.1), (B, 0.9)], [1, 0]),
    ],
)
def test_matching(
    truth: list[tuple[float, float]], detections: list[tuple[tuple[float, float], float]], found: list[int]
) -> None:
    assert match(prepare(frame(truth, *detections)), 0.5).tolist() == found


@pytest.mark.parametrize(
    ("points", "min_points", "detections", "truth_count", "ap"),
    [
        # without a minimum an object that no point hit is to be found
        ([5, 0], 0, [(A, 0.9)], 2, 0.5),
        # with one it is not
        ([5, 0], 1, [(A, 0.9)], 1, 1.0),
        # as many points as the minimum are enough
        ([5, 5], 5, [(A, 0.9)], 2, 0.5),
        # to find an ignored object is no mistake, however sure the detector is
        ([5, 0], 1, [(B, 0.9), (A, 0.8)], 1, 1.0),
        # nor is it to find it twice
        ([5, 0], 1, [(B, 0.9), (B, 0.85), (A, 0.8)], 1, 1.0),
        # next to an ignored object, with too little overlap, a detection is false
        ([5, 0], 1, [((22.0, 0.0), 0.9), (A, 0.8)], 1, 0.5),
        # a duplicate of an object that counts is false
        ([5, 0], 1, [(A, 0.9), (A, 0.8)], 1, 1.0),
        # nothing counts, nothing is defined
        ([5, 0], 9, [(A, 0.9)], 0, math.nan),
    ],
)
def test_objects_with_few_points_are_ignored(
    points: list[int], min_points: int, detections: list[tuple[tuple[float, float], float]], truth_count: int, ap: float
) -> None:
    one = dataclasses.replace(frame([A, B], *detections), point_count=np.array(points))
    report = evaluate_detections([one], min_points=min_points)
    assert (report.overall.truth, report.ignored_truth) == (truth_count, 2 - truth_count)
    assert report.ap(0.5) == pytest.approx(ap, nan_ok=True)


def test_evaluated_object_is_matched_before_ignored_one() -> None:
    truth = cars(A, (10.5, 0.0))
    scene = prepare(DetectionFrame(cars((10.4, 0.0), (10.4, 0.0), score=[0.9, 0.8]), truth, np.array([9, 0])), None, 1)
    assert match(scene, 0.5).tolist() == [0, DROPPED]


@pytest.mark.parametrize(
    ("detections", "outside", "ap"),
    [
        # an object outside need not be found
        ([(A, 0.9)], 0, 1.0),
        # a detection outside does not exist, whether it found something or not
        ([(A, 0.8), (C, 0.9), ((50.0, 0.0), 0.9)], 2, 1.0),
        # a detection inside of an object that is just outside is dropped
        ([((20.1, 0.0), 0.9), (A, 0.8)], 0, 1.0),
        # a detection just outside of an object inside does not find it
        ([((9.5, 3.2), 0.9)], 1, 0.0),
    ],
)
def test_outside_the_range(detections: list[tuple[tuple[float, float], float]], outside: int, ap: float) -> None:
    report = evaluate_detections([frame([A, (20.6, 0.0), C], *detections)], evaluation_range=(-20.0, 20.5, -3.0, 3.0))
    assert (report.overall.truth, report.ignored_truth, report.detections_outside) == (1, 2, outside)
    assert report.ap(0.5) == ap


def test_the_borders_belong_to_the_range() -> None:
    report = evaluate_detections([frame([A, B], (A, 0.9), (B, 0.9))], evaluation_range=(10.0, 20.0, 0.0, 1.0))
    assert (report.overall.truth, report.detections_outside) == (2, 0)


def test_range_bins_use_the_matched_object() -> None:
    # A true detection at 30.2 m of an object at 29.9 m, a missed object at 30 m, and a false detection at 60 m.
    one = frame([(29.9, 0.0), (0.0, 30.0)], ((30.2, 0.0), 0.9), ((-60.0, 0.0), 0.8))
    report = evaluate_detections([one])
    bins = {name: (group.truth, group.at[0.5].detections) for name, group in report.by_range.items()}
    assert bins == {"0-30 m": (1, 1), "30-50 m": (1, 0), "50-100 m": (0, 1), ">= 100 m": (0, 0)}
    assert report.by_range["0-30 m"].at[0.5].ap["global"] == 1.0
    assert report.by_range["30-50 m"].at[0.5].ap["global"] == 0.0
    assert math.isnan(report.by_range["50-100 m"].at[0.5].ap["global"])
    assert (report.overall.truth, report.overall.at[0.5].detections) == (2, 2)


def test_recall_and_precision_use_confident_detections() -> None:
    one = frame([A, B, C], (A, 0.9), (NOWHERE, 0.5), (B, 0.3), (C, 0.29))
    score = evaluate_detections([one], score_threshold=0.3).overall.at[0.5]
    assert (score.recall, score.precision, score.detections) == pytest.approx((2 / 3, 2 / 3, 4))


@pytest.mark.parametrize(
    ("shift", "yaw", "expected"),
    [
        # 0.2 m too far back, for a car that looks along y: longitudinal -0.2, which is nearer to the agent, too
        ((0.0, -0.2), 0.0, {"distance": 0.2, "longitudinal": -0.2, "lateral": 0.0, "radial": -0.2}),
        # 0.3 m towards x is to its right
        ((0.3, 0.0), 0.0, {"distance": 0.3, "longitudinal": 0.0, "lateral": -0.3, "radial": 0.0}),
        # half a turn is a flip, and no error of yaw
        ((0.0, 0.0), math.pi, {"flipped": 1.0, "yaw": 0.0}),
        # a small error of yaw is a magnitude
        ((0.0, 0.0), -0.1, {"flipped": 0.0, "yaw": 0.1}),
        # flipped and 0.1 rad off
        ((0.0, 0.0), math.pi + 0.1, {"flipped": 1.0, "yaw": 0.1}),
    ],
)
def test_errors_of_the_boxes_found(shift: tuple[float, float], yaw: float, expected: dict[str, float]) -> None:
    truth = cars((0.0, 10.0), yaw=math.pi / 2)
    detection = cars(shift, score=[0.9], yaw=math.pi / 2 + yaw)
    detection = detection.replace(center=detection.center + [0.0, 10.0, 0.1], size=[(4.2, 1.9, 1.5)])
    unsure = cars((0.0, 30.0), (5.0, 0.0), score=[0.1, 0.9])  # neither an unsure nor a false detection has errors
    both = Boxes.concatenate([detection, unsure])
    errors = evaluate_detections([DetectionFrame(both, Boxes.concatenate([truth, cars((0.0, 30.0))]))]).errors
    assert errors.count == 1
    assert {name: getattr(errors, name) for name in expected} == pytest.approx(expected, abs=1e-12)
    assert (errors.vertical, errors.length, errors.width, errors.height) == pytest.approx((0.1, 0.2, -0.1, 0.0))


def test_recall_by_label_where_there_are_labels() -> None:
    truth = Boxes.concatenate([cars(A, B, label="car"), cars(C, label="truck")])
    frames = [DetectionFrame(cars(A, C, score=[0.9, 0.1]), truth), DetectionFrame(Boxes.empty(), Boxes.empty())]
    labels = evaluate_detections(frames).labels
    assert {name: (one.truth, one.recall) for name, one in labels.items()} == {"car": (2, 0.5), "truck": (1, 0.0)}
    assert evaluate_detections([frame([A], (A, 0.9))]).labels == {}


def test_a_report_becomes_json() -> None:
    document = json.loads(json.dumps(dataclasses.asdict(evaluate_detections([frame([A], (A, 0.9))]))))
    assert document["overall"]["at"]["0.5"]["ap"] == {"global": 1.0, "frame-order": 1.0}


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: DetectionFrame(cars(A), cars(A), name="f7", agent="car1"), "f7: car1: detections: score"),
        (
            lambda: DetectionFrame(cars(), cars(A), point_count=np.zeros(2, dtype=np.int64)),
            r"point_count must have shape \(1,\)",
        ),
        (lambda: evaluate_detections([frame([A])], min_points=1), "min_points=1 needs"),
        (lambda: evaluate_detections([], thresholds=()), "thresholds"),
        (lambda: evaluate_detections([], thresholds=(50.0,)), "thresholds"),
        (lambda: evaluate_detections([frame([A])], evaluation_range=(1.0, -1.0, 0.0, 1.0)), "evaluation_range"),
    ],
)
def test_invalid_input_error_names_the_field(make: object, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        make()  # type: ignore[operator]


def test_failures_list_missed_and_false_detections() -> None:
    detections = cars(NOWHERE, A, A, (20.0, 1.5), (40.0, 0.2), score=[0.8, 0.9, 0.7, 0.6, 0.1])
    one = DetectionFrame(
        detections, cars(A, B, C, label="car"), np.array([9, 8, 7]), "s/1", "car1", np.array([1, 9, 9, 4, 0])
    )
    failures = list(find_failures(one))
    assert [(f.kind, f.row, f.x, f.points, f.score) for f in failures] == [
        ("missed", 1, 20.0, 8, 0.6),  # overlapped too little
        ("missed", 2, 40.0, 7, 0.1),  # overlapped well, by a detection that is not sure enough
        ("false", 0, 0.0, 1, 0.8),  # nothing there
        ("false", 2, 10.0, 9, 0.7),  # a duplicate
        ("false", 3, 20.0, 4, 0.6),
    ]
    assert [f.best_iou for f in failures] == pytest.approx([1 / 7, 1.8 / 2.2, 0.0, 1.0, 1 / 7])
    assert {(f.frame, f.agent) for f in failures} == {("s/1", "car1")}
    assert [f.label for f in failures] == ["car", "car", "", "", ""]


def oracle(frames: list[DetectionFrame], threshold: float, globally: bool) -> float:
    """AP by the book, slowly: shapely for the overlap, one detection at a time over the whole split."""
    listed = []
    for number, one in enumerate(frames):
        scores = [] if one.detections.score is None else one.detections.score.tolist()
        polygons = shapely.polygons(one.detections.bev_corners())
        ranked = sorted(range(len(scores)), key=lambda i: -scores[i])
        listed += [(number, polygons[i], scores[i]) for i in ranked]
    if globally:
        listed.sort(key=lambda item: -item[2])
    left = {n: list(shapely.polygons(one.truth.bev_corners())) for n, one in enumerate(frames)}
    total = sum(len(polygons) for polygons in left.values())
    points, true = [(0.0, 1.0)], 0
    for count, (number, polygon, _) in enumerate(listed, start=1):
        overlaps = [polygon.intersection(other).area / polygon.union(other).area for other in left[number]]
        if overlaps and max(overlaps) >= threshold:
            true += 1
            left[number].pop(overlaps.index(max(overlaps)))
        points.append((true / total, true / count))
    area = 0.0
    for level in range(1, true + 1):  # the step of recall to level / total, at the best precision from there on
        area += max(p for r, p in points[1:] if r >= level / total - 1e-12) / total
    return area


@pytest.mark.parametrize("seed", range(12))
def test_average_precision_is_that_of_a_slow_oracle(seed: int) -> None:
    rng = np.random.default_rng([seed, 5])
    frames = []
    for _ in range(8):
        truth, n = random_boxes(rng, int(rng.integers(0, 12))), int(rng.integers(0, 16))
        made_up = random_boxes(rng, n)
        found = truth.replace(
            center=truth.center + rng.normal(0.0, 0.5, (len(truth), 3)),
            yaw=truth.yaw + rng.normal(0.0, 0.2, len(truth)),
        )
        both = Boxes.concatenate([made_up, found, found[rng.random(len(found)) < 0.2]])
        frames.append(DetectionFrame(both.replace(score=rng.integers(0, 25, len(both)) / 24.0), truth))
    report = evaluate_detections(frames)
    for threshold in (0.3, 0.5, 0.7):
        assert report.ap(threshold) == pytest.approx(oracle(frames, threshold, globally=True), abs=1e-9)
        assert report.ap(threshold, "frame-order") == pytest.approx(oracle(frames, threshold, globally=False), abs=1e-9)


def random_boxes(rng: np.random.Generator, n: int) -> Boxes:
    """Boxes close enough together that some overlap."""
    center = np.column_stack([rng.uniform(-15.0, 15.0, (n, 2)), np.zeros(n)])
    return Boxes(center, rng.uniform([3.5, 1.6, 1.4], [6.0, 2.2, 2.0], (n, 3)), rng.uniform(-math.pi, math.pi, n))
