"""Metrics of a study on hand-made results."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cobevglue.boxes import Boxes
from cobevglue.experiments.condition import Condition
from cobevglue.experiments.measure import Results, pose_quality
from cobevglue.experiments.results import ConditionResult, FrameResult, FrameTruth, ReceivedPose, ScenarioResult

CONDITION = Condition(fusion="late", aligner="given")
RANGE = (-50.0, 50.0, -30.0, 30.0)


def cars(*x: float, score: float | None = None) -> Boxes:
    """Cars in a row along x."""
    n = len(x)
    scores = None if score is None else np.full(n, score)
    return Boxes(np.column_stack([x, np.zeros(n), np.zeros(n)]), np.tile((4.0, 2.0, 1.5), (n, 1)), np.zeros(n), scores)


def received(agent: str, error: float, degrees: float, payload: int = 1000, alignment: int = 100) -> ReceivedPose:
    reason = "" if math.isfinite(error) else "doubtful"
    sent = {"features": payload, "boxes": alignment}
    return ReceivedPose(agent, error, math.radians(degrees), error, reason, sent, alignment)


def results(*frames: tuple[Boxes, Boxes, tuple[ReceivedPose, ...]], points: int = 9, **kept: int) -> Results:
    """One sequence: truth, detections and received poses of each frame; 3 objects are co-visible with each agent."""
    truth = [
        FrameTruth(f"{i}", true, np.full(len(true), points), {h.agent: 3 for h in who}, {"head": 0.02 * (1 + len(who))})
        for i, (true, _, who) in enumerate(frames)
    ]
    run = ConditionResult(
        CONDITION,
        "",
        {i: FrameResult(found, who, {"fusion": 0.01 * (i + 1)}) for i, (_, found, who) in enumerate(frames)},
    )
    return Results([ScenarioResult("d", "ego", truth, kept, {CONDITION.key: run})], RANGE, 5)


def test_average_precision_is_over_all_frames_together() -> None:
    made = results((cars(0, 10), cars(0, 10, score=0.9), ()), (cars(0, 10), cars(0, 30, score=0.5), ()))
    # Three of four are found, the false one among the last two of equal score: the envelope stays at 3/3.
    assert made.ap(CONDITION, 0.7) == pytest.approx(0.75)


def test_outside_or_barely_hit_objects_are_ignored() -> None:
    found = cars(0, 60, score=0.9)
    assert results((cars(0, 60), found, ())).ap(CONDITION, 0.5) == 1.0
    assert results((cars(0, 60), found, ())).object_count == 1
    assert math.isnan(results((cars(0), found, ()), points=4).ap(CONDITION, 0.5))
    assert results((cars(0), found, ()), points=4).object_count == 0


def test_precision_may_use_a_subset_of_frames() -> None:
    made = results((cars(0), cars(0, score=0.9), ()), (cars(0), cars(20, score=0.9), ()))
    assert made.ap(CONDITION, 0.5) == 0.5
    assert made.ap(CONDITION, 0.5, every=2) == 1.0


def test_bytes_are_of_one_collaborator_in_one_frame() -> None:
    both = received("a", 0.1, 0.1, 1000, 100), received("b", 0.1, 0.1, 4000, 300)
    made = results((cars(0), cars(score=0.5), both), (cars(0), cars(score=0.5), both[:1]))
    assert made.payload_bytes(CONDITION) == 2000.0
    assert made.alignment_bytes(CONDITION) == pytest.approx(500 / 3)
    alone = results((cars(0), cars(score=0.5), ()))
    assert math.isnan(alone.payload_bytes(CONDITION))
    assert alone.frames_without_collaborators == 1


def test_times_are_medians_per_cloud() -> None:
    company = (received("a", 0.1, 0.1),)
    made = results(*[(cars(0), cars(score=0.5), company)] * 3)
    assert made.milliseconds(CONDITION) == pytest.approx({"fusion": 20.0})
    assert made.perception_milliseconds() == pytest.approx({"head": 20.0})


def test_omitted_frames_are_summed() -> None:
    one = results((cars(0), cars(score=0.5), ()), without=2).sequences[0]
    assert Results([one, one], RANGE, 5).left_out == {"without": 4}
    assert Results([one, one], RANGE, 5).frame_count == 2


def test_success_refusals_and_wrong_poses_are_counted() -> None:
    quality = pose_quality(
        [
            received("good", 0.5, 0.5),
            received("fair", 1.5, 0.5),
            received("turned", 0.5, 2.5),
            received("wrong", 9.0, 0.0),
            received("refused", math.inf, math.inf),
        ]
    )
    assert (quality.count, quality.refused, quality.wrong) == (5, 0.2, 0.25)
    assert (quality.success_1, quality.success_2, quality.success_3) == pytest.approx((0.2, 0.4, 0.6))
    assert (quality.translation, quality.yaw) == pytest.approx((1.0, 0.5))


def test_without_anybody_there_are_no_shares() -> None:
    quality = pose_quality([])
    assert quality.count == 0
    assert math.isnan(quality.refused)
    assert math.isnan(quality.wrong)
    assert math.isnan(quality.translation)
