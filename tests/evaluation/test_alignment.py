"""Measures of alignment: hand-made records, and the real data where it is there."""

from __future__ import annotations

import itertools
import math
import os
from pathlib import Path

import numpy as np
import pytest

from cobevglue import SE2, Alignment, BEVGlue, Boxes
from cobevglue.datasets import OPV2V
from cobevglue.disturbance.detection_errors import DetectionErrors
from cobevglue.evaluation.alignment import (
    AlignmentSequence,
    PairFrame,
    Record,
    by_co_visible,
    evaluate,
    landing_error,
    off_by_3,
    summarise,
)
from cobevglue.evaluation.alignment_data import noisy_label_sequences, smooth_trajectory, v2v4real_sequences

DATA = Path(os.environ.get("COBEVGLUE_DATA", Path(__file__).parents[2].parent / "shared" / "data"))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"COBEVGLUE_DATA: no folder {DATA}")


def boxes(*xy: tuple[float, float]) -> Boxes:
    """Cars at these places."""
    return Boxes([(x, y, 0.0) for x, y in xy], [(4.5, 1.9, 1.6)] * len(xy), [0.0] * len(xy))


def record(co_visible: int = 4, accepted: bool = True, t: float = 0.5, yaw: float = 0.5, land: float = 0.5) -> Record:
    """A record with errors in metres and degrees."""
    if not accepted:
        t = yaw = land = math.inf
    return Record("s", co_visible, accepted, t, math.radians(yaw), land, 3, 4, 5, 1e-3)


@pytest.mark.parametrize(
    ("estimate", "other", "expected"),
    [
        (SE2(0, 0, 0), boxes((5, 0)), 0.0),  # the true pose lands every box where it is
        (SE2(3, 4, 0), boxes((5, 0), (50, 9)), 5.0),  # a shift moves all boxes alike
        (SE2(0, 0, math.pi), boxes((5, 0), (0, 10)), 15.0),  # half a turn moves a box by twice its distance
        (SE2(0, 2, 0), boxes(), 2.0),  # without boxes the other's origin counts
    ],
)
def test_landing_error(estimate: SE2, other: Boxes, expected: float) -> None:
    assert landing_error(estimate, SE2(), other) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("one", "right", "success", "wrong_by_3"),
    [
        (record(), True, (True, True, True), False),  # everything within a metre and a degree
        (record(t=1.5), True, (False, True, True), False),  # a translation of 1.5 m fails the first
        (record(yaw=2.5), True, (False, False, True), False),  # a yaw of 2.5 degrees fails the first two
        (record(t=9.0, land=2.9), True, (False, False, False), True),  # far off at the origin, right at the boxes
        (record(t=0.1, land=3.0), False, (True, True, True), False),  # boxes 3 m off are not right
        (record(accepted=False), False, (False, False, False), True),  # a refusal is never a success
    ],
)
def test_record(one: Record, right: bool, success: tuple[bool, bool, bool], wrong_by_3: bool) -> None:
    assert one.right == right
    assert (one.success(1), one.success(2), one.success(3)) == success
    assert off_by_3(one) == wrong_by_3


def test_summary_counts_wrong_ones_among_the_accepted_only() -> None:
    summary = summarise([record(), record(), record(land=8.0), record(accepted=False)])
    assert summary.frames == 4
    assert summary.right == pytest.approx(2 / 4)
    assert summary.refused == pytest.approx(1 / 4)
    assert summary.wrong_of_accepted == pytest.approx(1 / 3)
    assert (summary.match_precision, summary.match_recall) == pytest.approx((3 / 4, 3 / 5))
    assert summary.median_milliseconds == pytest.approx(1.0)


def test_summary_of_nothing_has_no_shares() -> None:
    summary = summarise([])
    assert summary.frames == 0
    assert all(math.isnan(v) for v in (summary.right, summary.wrong_of_accepted, summary.median_milliseconds))


def test_co_visible_groups_overlap_as_named() -> None:
    groups = by_co_visible([record(co_visible=k) for k in (0, 1, 1, 2, 3, 4, 9)])
    assert {name: group.frames for name, group in groups.items()} == {
        "all": 7,
        "0": 1,
        "1": 2,
        "2": 1,
        "3": 1,
        ">= 2": 4,
        ">= 4": 2,
    }
    assert ">= 2" not in by_co_visible([record(co_visible=0)])


def test_evaluate_compares_with_the_truth_frame_by_frame() -> None:
    class Fixed:
        """Says the same every time."""

        def align(self, ego: Boxes, other: Boxes, time: float | None = None) -> Alignment:
            return Alignment(SE2(1.0, 0.0, 0.0), np.array([[0, 0], [1, 0]]))

        def reset(self) -> None:
            raise AssertionError("a sequence gets a fresh aligner instead")

    pair = np.array([[0, 0], [1, 1]])
    frames = [PairFrame(boxes((0, 0), (9, 0)), boxes((0, 0), (9, 0)), SE2(k, 0, 0), 2, pair) for k in (1.0, 3.0)]
    first, second = evaluate([AlignmentSequence("s", frames)], Fixed)
    assert (first.translation_error, first.landing_error) == (0.0, 0.0)
    assert (second.translation_error, second.landing_error) == (2.0, 2.0)
    assert (first.true_matches, first.found_matches, first.possible_matches) == (1, 2, 2)


def test_a_trajectory_is_smooth_and_repeatable() -> None:
    trajectory = smooth_trajectory(3, 200)
    assert trajectory == smooth_trajectory(3, 200) != smooth_trajectory(4, 200)
    steps = [a.inverse() @ b for a, b in itertools.pairwise(trajectory)]
    assert max(math.hypot(s.x, s.y) for s in steps) < 1.6  # m in 0.1 s
    assert max(abs(s.yaw) for s in steps) < 0.02  # rad in 0.1 s


@needs_data
def test_the_stored_identity_of_recorded_detections_is_hidden() -> None:
    (sequence,) = v2v4real_sequences(DATA / "v2v4real_detections", ("val/0004",))
    for frame in sequence.frames:
        assert frame.ego_SE2_other.error_to(SE2()) > (1.0, 0.0)
        both = frame.other.transform(frame.ego_SE2_other)
        gap = np.linalg.norm(frame.ego.center[:, None, :2] - both.center[None, :, :2], axis=-1).min(axis=1)
        assert np.quantile(gap, 0.3) < 1.0  # what both cars detect coincides once it is brought back


@needs_data
def test_a_frame_can_stay_at_its_first_pose() -> None:
    (moving,) = v2v4real_sequences(DATA / "v2v4real_detections", ("val/0004",))
    (constant,) = v2v4real_sequences(DATA / "v2v4real_detections", ("val/0004",), moving=False)
    assert {frame.ego_SE2_other for frame in constant.frames} == {moving.frames[0].ego_SE2_other}


@needs_data
@pytest.mark.parametrize(
    ("name", "least"),
    [("val/0004", 0.95), ("val/0008", 0.95), ("train/0006", 0.9)],  # many co-visible objects, moderate, few
)
def test_real_cars_find_each_other(name: str, least: float) -> None:
    records = list(evaluate(v2v4real_sequences(DATA / "v2v4real_detections", (name,)), BEVGlue))
    groups = by_co_visible(records)
    assert groups[">= 4"].right > least
    assert groups["all"].wrong_of_accepted <= 0.01


@needs_data
def test_real_cars_with_nothing_in_common_never_meet() -> None:
    records = list(evaluate(v2v4real_sequences(DATA / "v2v4real_detections", ("val/0001",)), BEVGlue))
    assert len(records) == 114
    assert not any(r.accepted for r in records)


@needs_data
def test_opv2v_agents_align_despite_detection_errors() -> None:
    labels = OPV2V(DATA / "opv2v", "test_culvercity")
    records = [r for s in noisy_label_sequences(labels, DetectionErrors()) for r in evaluate([s], BEVGlue)]
    summary = summarise([r for r in records if r.co_visible >= 4], off_by_3)
    assert summary.frames == 495
    assert summary.success_1 > 0.9
    assert summary.success_3 > 0.99
    assert summary.wrong_of_accepted <= 0.005
    assert summary.match_precision > 0.99
