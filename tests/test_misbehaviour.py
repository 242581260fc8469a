"""Misbehaviour: contradictions in plain view are found, honest lists are not reported."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from cobevglue import SE2, Boxes
from cobevglue.alignment import Alignment
from cobevglue.misbehaviour import MisbehaviourDetector, MisbehaviourReport, share_evidence

_Places = list[tuple[float, float]]
EGO_SE2_OTHER = SE2(10.0, 5.0, 0.5)
REAL = [(15.0, 8.0), (20.0, -10.0), (-12.0, 6.0), (5.0, 18.0), (25.0, 15.0), (-8.0, -14.0)]
NOBODY_SAW = [(12.0, -6.0), (-15.0, -4.0), (8.0, 10.0), (18.0, 2.0), (-6.0, 12.0), (2.0, -15.0), (-10.0, 16.0)]


def cars(places: list[tuple[float, float]], first_id: int = 0) -> Boxes:
    n = len(places)
    center = np.column_stack([np.reshape(places, (n, 2)), np.full(n, -1.0)])
    return Boxes(center, np.tile((4.5, 1.9, 1.6), (n, 1)), np.zeros(n), track_id=first_id + np.arange(n))


def watch(
    seen: Boxes, told: Boxes, frames: int = 12, detector: MisbehaviourDetector | None = None, **fields: float
) -> MisbehaviourReport:
    """The last report; `told` is in the ego frame, moves a little in each frame, and is sent in the other's frame."""
    detector = detector or MisbehaviourDetector()
    known: dict[str, Any] = {"risk": 0.001, "evidence": 30.0, "margin": 25.0} | fields
    alignment = Alignment(EGO_SE2_OTHER, covariance=np.eye(3) * 0.01, **known)
    for frame in range(frames):
        moved = told.replace(center=told.center + [0.001 * frame, 0.0, 0.0])
        report = detector.update(seen, moved.transform(EGO_SE2_OTHER.inverse()), alignment)
    return report


@pytest.mark.parametrize(
    ("why", "seen", "told", "names"),
    [
        ("the same objects", REAL, REAL, []),
        ("one object more may be one that the ego misses", REAL, REAL + NOBODY_SAW[:1], []),
        ("many objects that the ego should see", REAL, REAL[:2] + NOBODY_SAW, ["PerceivedObject-NotSeen"]),
        ("all but one object left out", REAL + NOBODY_SAW, REAL[:1], ["PerceivedObject-Missing"]),
        ("objects far away are in nobody's plain view", REAL, REAL[:3] + [(80.0 + 9 * k, 5.0) for k in range(9)], []),
    ],
)
def test_lists_in_plain_view(why: str, seen: _Places, told: _Places, names: list[str]) -> None:
    report = watch(cars(seen), cars(told))
    assert [o.name for o in report.observations] == names, why
    assert report.misbehaving is bool(names), why


def test_shifted_objects_are_displaced() -> None:
    shifted = [(x + 3.0, y + 3.0) for x, y in REAL + NOBODY_SAW]
    report = watch(cars(REAL + NOBODY_SAW), cars(shifted))
    assert report.observations[0].name == "PerceivedObject-Displaced"


def test_hidden_objects_are_no_evidence() -> None:
    """A row of vehicles behind a lorry: the ego cannot see them."""
    lorry = Boxes([(10.0, 0.0, 0.0)], [(3.0, 14.0, 4.0)], [0.0], track_id=[99])
    behind = [(18.0 + 5 * k, 0.0) for k in range(4)]
    assert watch(lorry, Boxes.concatenate([lorry, cars(behind)])).tested[0] <= 1


def test_wrong_alignments_are_no_evidence() -> None:
    told = cars(REAL[:2] + NOBODY_SAW)
    assert watch(cars(REAL), told, risk=0.04).tested == (0, 0)
    assert watch(cars(REAL), told, margin=2.0).tested == (0, 0)


def test_few_frames_are_no_evidence() -> None:
    assert watch(cars(REAL), cars(NOBODY_SAW), frames=4).tested == (0, 0)


def test_same_list_again_is_a_replay() -> None:
    """Also where the alignment was refused."""
    detector, refused = MisbehaviourDetector(), Alignment.refused("no")
    boxes = cars(REAL)
    recorded = [boxes.replace(center=boxes.center + 0.1 * frame) for frame in range(10)]
    for other in recorded:
        assert not detector.update(boxes, other, refused).misbehaving
    reports = [detector.update(boxes, other, refused) for other in recorded]
    assert [r.misbehaving for r in reports] == [False] * 2 + [True] * 8
    assert reports[-1].observations[0].name == "ObjectList-Replayed"


def test_list_sent_twice_is_no_replay() -> None:
    detector, boxes, refused = MisbehaviourDetector(), cars(REAL), Alignment.refused("no")
    for frame in range(10):
        other = boxes.replace(center=boxes.center + 0.1 * (frame // 2))
        assert not detector.update(boxes, other, refused).misbehaving


def test_more_evidence_excludes() -> None:
    some = watch(cars(REAL), cars(REAL[:2] + NOBODY_SAW))
    assert some.misbehaving
    assert not some.exclude
    assert watch(cars(REAL), cars(NOBODY_SAW + [(-18.0, 10.0), (0.0, 24.0)])).exclude


def test_old_evidence_is_forgotten() -> None:
    detector = MisbehaviourDetector()
    assert watch(cars(REAL), cars(REAL[:2] + NOBODY_SAW), detector=detector).misbehaving
    assert not watch(cars(REAL), cars(REAL), frames=80, detector=detector).misbehaving


@pytest.mark.parametrize(
    ("why", "missing", "share"),
    [
        ("no objects", [], 0.0),
        ("nothing missing", [False] * 5, 0.0),
        ("as many missing as honest detectors miss", [True] + [False] * 4, 0.0),
        ("all missing", [True] * 5, 0.95),
    ],
)
def test_share_evidence_by_hand(why: str, missing: list[bool], share: float) -> None:
    evidence, best = share_evidence(np.array(missing, np.bool_), np.full(len(missing), 0.25))
    assert best == share, why
    expected = len(missing) * math.log(0.05 + 0.95 / 0.25) if share else 0.0
    assert evidence == pytest.approx(expected), why


def test_report_is_json_with_evidence() -> None:
    report = watch(cars(REAL), cars(REAL[:2] + NOBODY_SAW))
    written = json.loads(json.dumps(report.as_dict("car2")))
    assert written["subject"] == "car2"
    assert written["observations"][0]["detectionClass"] == 4
    assert written["nonV2xPduEvidence"][0]["logLikelihoodRatio"] > 0.0


def test_boxes_need_track_ids() -> None:
    boxes = cars(REAL)
    with pytest.raises(ValueError, match="other: boxes have no track ids"):
        MisbehaviourDetector().update(boxes, boxes.replace(track_id=None), Alignment.refused("no"))
