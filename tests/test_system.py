"""The five steps together, on the real OPV2V frames and on small made-up clouds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch

from cobevglue import BEVGlue, CoBEVGlue
from cobevglue.alignment import ALIGNERS, Alignment, GroupAligner, Observation, group_aligner
from cobevglue.alignment.group import Pairwise
from cobevglue.boxes import Boxes, covers_origin
from cobevglue.datasets import OPV2V
from cobevglue.datasets.poses import inverse_SE3
from cobevglue.fusion import FUSION_METHODS, FusionMethod, IntermediateFusion, fusion_class
from cobevglue.iou import bev_iou
from cobevglue.perception import PointPillars, PointPillarsConfig
from cobevglue.se2 import SE2

SMALL = PointPillarsConfig(
    x_range=(-12.8, 12.8), y_range=(-6.4, 6.4), pillar_channels=16, block_layers=(1, 1, 1), block_channels=(8, 8, 8),
    up_channels=8, shrink_channels=8,
)  # fmt: skip


def small_detector() -> PointPillars:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return PointPillars(SMALL).eval()


def method(name: str, detector: PointPillars) -> FusionMethod:
    """Untrained beyond the detector's neck and head, ready to be used."""
    made = fusion_class(name)(detector)
    return made.eval() if isinstance(made, IntermediateFusion) else made


def cloud(seed: int, count: int = 400) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform([-12, -6, -2, 0], [12, 6, 0, 1], (count, 4)).astype(np.float32)


def pose(x: float, y: float, yaw: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:2, :2] = SE2(x, y, yaw).rotation
    matrix[:2, 3] = x, y
    return matrix


class Fixed(GroupAligner):
    """Everyone stands where this says; those it does not name are refused."""

    needs = frozenset({"boxes"})

    def __init__(self, poses: Mapping[str, SE2]) -> None:
        self.poses = poses
        self.observations: dict[str, Observation] = {}

    def align_group(
        self, ego: str, observations: Mapping[str, Observation], time: float | None = None
    ) -> dict[str, Alignment]:
        self.observations = dict(observations)
        names = [name for name in observations if name != ego]
        return {n: Alignment(self.poses[n]) if n in self.poses else Alignment.refused("unknown") for n in names}


RealFrames = list[tuple[dict[str, np.ndarray], dict[str, np.ndarray], float]]
"""Clouds, true poses, and time."""


@pytest.fixture(scope="module")
def frames(request: pytest.FixtureRequest) -> RealFrames:
    """Clouds, true poses and times of three real frames."""
    root: Path = request.getfixturevalue("culver_city")
    scenario = OPV2V(root, split="test_culvercity")["TwoCars_1"]
    chosen = [frame for frame in scenario if all(agent.points is not None for agent in frame.agents.values())][:3]
    return [
        (
            {name: agent.points for name, agent in frame.agents.items() if agent.points is not None},
            {name: agent.world_SE3_lidar for name, agent in frame.agents.items()},
            frame.time,
        )
        for frame in chosen
    ]


@pytest.fixture(scope="module")
def compact() -> PointPillars:
    return PointPillars.pretrained("compact")


def test_self_localised_output_ignores_claimed_poses(frames: RealFrames, compact: PointPillars) -> None:
    absurd = {"car1": pose(1e6, -4e5, 2.0), "car2": np.full((4, 4), np.nan)}
    outputs: list[list[tuple[bytes, SE2 | None]]] = []
    for claims in ("none", "true", "absurd"):
        system = CoBEVGlue(compact, method("cobevglue", compact), group_aligner("bevglue"))
        outputs.append([])
        for clouds, true, time in frames:
            out = system.step(clouds, "car1", time, {"none": None, "true": true, "absurd": absurd}[claims])
            assert out.boxes.score is not None
            boxes = (out.boxes.center, out.boxes.size, out.boxes.yaw, out.boxes.score)
            outputs[-1].append((b"".join(a.tobytes() for a in boxes), out.alignments["car2"].ego_SE2_other))
    assert outputs[0] == outputs[1] == outputs[2]
    assert outputs[0][-1][1] is not None


def test_bevglue_pose_is_right_and_reveals_hidden(frames: RealFrames, compact: PointPillars) -> None:
    system = CoBEVGlue(compact, method("late", compact), group_aligner("bevglue"))
    for clouds, poses, time in frames:
        out = system.step(clouds, "car1", time)
        true = SE2.from_matrix(inverse_SE3(poses["car1"]) @ poses["car2"])
        found = out.alignments["car2"].ego_SE2_other
        assert found is not None
        assert found.error_to(true)[0] < 1.0
        assert len(out.boxes) > 0
        sent = out.message_bytes["car2"]
        assert sent["features"] == 0
        assert sent["boxes"] > out.alignment_bytes["car2"] > 0


def test_output_headings_follow_transmitted_headings(frames: RealFrames, compact: PointPillars) -> None:
    """The fused head is made to mix up front and back; the boxes that the ego tracks know better."""
    confused = method("cobevglue", compact)
    assert isinstance(confused, IntermediateFusion)
    with torch.no_grad():
        for values in confused.head.direction.parameters():
            values.mul_(-1.0)
    system = CoBEVGlue(compact, confused, group_aligner("bevglue"))
    clouds, _, time = frames[0]
    seen = {"car1": system.perceive("car1", clouds["car1"], time)}
    boxes, own = system.collaborate(seen, "car1", time).boxes, seen["car1"].boxes
    iou = bev_iou(boxes, own)
    rows = np.flatnonzero(iou.max(axis=1) > 0.5)
    assert len(rows) > 10
    assert (np.cos(boxes.yaw[rows] - own.yaw[iou[rows].argmax(axis=1)]) > 0).all()


def test_feature_message_is_three_float16_maps() -> None:
    detector = small_detector()
    system = CoBEVGlue(detector, method("cobevglue-features", detector), Fixed({"b": SE2()}))
    out = system.step({"a": cloud(1), "b": cloud(2)}, "a")
    numbers = 8 * (16 * 32 + 8 * 16 + 4 * 8)
    assert out.message_bytes["b"]["features"] == 2 * numbers + 6 + 4 + 3 * (1 + 4 + 2 + 12)
    assert set(out.message_bytes) == {"b"}  # the ego sends nothing to itself


@pytest.mark.parametrize("name", FUSION_METHODS)
def test_refused_agents_are_not_fused(name: str) -> None:
    detector = small_detector()
    alone, refused = method(name, detector), method(name, detector)
    if isinstance(alone, IntermediateFusion) and isinstance(refused, IntermediateFusion):
        refused.load_state_dict(alone.state_dict())
    one = CoBEVGlue(detector, alone, Fixed({})).step({"a": cloud(1)}, "a")
    two = CoBEVGlue(detector, refused, Fixed({})).step({"a": cloud(1), "b": cloud(2)}, "a")
    assert not two.alignments["b"].accepted
    np.testing.assert_array_equal(one.boxes.bev, two.boxes.bev)
    np.testing.assert_array_equal(one.boxes.score, two.boxes.score)


@pytest.mark.parametrize("name", FUSION_METHODS)
def test_methods_take_any_agents_and_empty_clouds(name: str) -> None:
    detector = small_detector()
    poses = {"b": SE2(3.0, 1.0, 0.2), "c": SE2(-4.0, 0.0, 3.0), "d": SE2(0.0, 2.0, -1.0)}
    system = CoBEVGlue(detector, method(name, detector), Fixed(poses))
    for clouds in (
        {"a": cloud(1)},
        {"a": cloud(1), "b": cloud(2), "c": cloud(3), "d": cloud(4)},
        {"a": cloud(1), "b": np.zeros((0, 4), np.float32)},
        {"a": np.zeros((0, 4), np.float32), "c": cloud(3)},
    ):
        out = system.step(clouds, "a")
        assert out.boxes.score is not None
        assert np.isfinite(out.boxes.bev).all()
        assert (np.diff(out.boxes.score) <= 0).all()
        assert set(out.alignments) == set(out.message_bytes) == set(clouds) - {"a"}


def test_the_ego_is_not_among_its_boxes() -> None:
    detector = small_detector()
    system = CoBEVGlue(detector, method("late", detector), Fixed({}))
    out = system.step({"a": cloud(5, 3000)}, "a")
    found = detector.detect(cloud(5, 3000))
    assert len(out.boxes) == len(found) - int(covers_origin(found).sum())


def test_aligner_receives_only_what_it_needs() -> None:
    detector = small_detector()
    aligner = Fixed({})
    system = CoBEVGlue(detector, method("none", detector), aligner)
    system.step({"a": cloud(1), "b": cloud(2)}, "a", poses={"a": np.eye(4), "b": np.eye(4)})
    for seen in aligner.observations.values():
        assert seen.boxes is not None
        assert (seen.pose, seen.points, seen.features, seen.variance) == (None, None, None, None)


def test_given_localisation_is_relative_claimed_pose() -> None:
    detector = small_detector()
    system = CoBEVGlue(detector, method("late", detector), group_aligner("given"))
    claims = {"a": pose(100.0, 50.0, 1.0), "b": pose(110.0, 50.0, 1.5)}
    out = system.step({"a": cloud(1), "b": cloud(2)}, "a", poses=claims)
    expected = SE2(100.0, 50.0, 1.0).inverse() @ SE2(110.0, 50.0, 1.5)
    found = out.alignments["b"].ego_SE2_other
    assert found is not None
    assert found.error_to(expected) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert out.message_bytes["b"]["pose"] == out.alignment_bytes["b"]


def test_nothing_fused_needs_no_poses() -> None:
    detector = small_detector()
    system = CoBEVGlue(detector, method("none", detector), group_aligner("given"))
    clouds = {"a": cloud(1), "b": cloud(2)}
    out = system.step(clouds, "a")
    assert not out.alignments["b"].accepted
    assert out.alignments["b"].reason == "no poses are given, and nothing is fused"
    assert out.alignment_bytes == {"b": 0}
    system.reset()
    told = system.step(clouds, "a", poses={"a": np.eye(4), "b": pose(5.0, 0.0, 0.5)})
    np.testing.assert_array_equal(out.boxes.bev, told.boxes.bev)


def test_agents_come_and_go_and_new_ego_resets() -> None:
    detector = small_detector()
    system = CoBEVGlue(detector, method("cobevglue", detector), group_aligner("bevglue"))
    for number, (names, ego) in enumerate([("ab", "a"), ("a", "a"), ("abc", "a"), ("bc", "b")]):
        out = system.step({name: cloud(ord(name)) for name in names}, ego, time=0.1 * number)
        assert set(out.alignments) == set(names) - {ego}
    system.reset()
    system.step({"a": cloud(1)}, "a", time=0.0)  # an earlier time is fine after a reset


@pytest.mark.parametrize(
    ("clouds", "ego", "poses", "problem"),
    [
        ({"car1": cloud(1)}, "car2", None, "ego: there is no agent 'car2'; did you mean 'car1'"),
        ({"car1": cloud(1), "car2": cloud(2)[:, :3]}, "car1", None, "car2: points must have shape"),
        ({"car1": cloud(1), "car2": cloud(2)}, "car1", None, "car1: GivenLocalisation needs pose of every agent"),
        ({"car1": cloud(1), "car2": cloud(2)}, "car1", {"car1": np.eye(4)}, "poses: car2: missing"),
        ({"car1": cloud(1)}, "car1", {"car1": np.eye(3)}, "poses: car1: must be finite numbers of shape"),
        ({"car1": cloud(1)}, "car1", {"car1": np.full((4, 4), np.nan)}, "poses: car1: must be finite"),
    ],
)
def test_bad_input_names_the_agent(
    clouds: dict[str, np.ndarray], ego: str, poses: dict[str, np.ndarray] | None, problem: str
) -> None:
    detector = small_detector()
    system = CoBEVGlue(detector, method("late", detector), group_aligner("given"))
    with pytest.raises(ValueError, match=problem):
        system.step(clouds, ego, poses=poses)


def test_unknown_name_error_names_nearest() -> None:
    with pytest.raises(ValueError, match=r"'cobevglu'; did you mean 'cobevglue'"):
        CoBEVGlue.pretrained("compact", fusion="cobevglu")
    with pytest.raises(ValueError, match=r"'bevgleu'; did you mean 'bevglue'"):
        CoBEVGlue.pretrained("compact", fusion="none", aligner="bevgleu")
    assert set(ALIGNERS) >= {"bevglue", "given"}


def test_own_vehicles_are_sent_with_boxes(compact: PointPillars) -> None:
    """The other agent's vehicle costs 32 bytes; the aligner is given both, and none where none is known."""

    class Listening(Pairwise):
        bodies: ClassVar[list[tuple[float | None, ...]]] = []

        def align_group(
            self, ego: str, observations: Mapping[str, Observation], time: float | None = None
        ) -> dict[str, Alignment]:
            found = (observations["1"].body, observations["2"].body)
            self.bodies.append(tuple(None if body is None else float(body.size[0, 0]) for body in found))
            return super().align_group(ego, observations, time)

    clouds = {"1": cloud(0), "2": cloud(1)}
    vehicles = {name: Boxes([(0, 0, -1)], [(length, 2.0, 1.5)], [0.0]) for name, length in (("1", 4.5), ("2", 12.0))}
    sent = []
    for bodies in (None, vehicles):
        system = CoBEVGlue(compact, method("late", compact), Listening(BEVGlue))
        sent.append(system.step(clouds, "1", 0.0, bodies=bodies).alignment_bytes["2"])
    assert Listening.bodies == [(None, None), (4.5, 12.0)]
    assert sent[1] - sent[0] == 32
