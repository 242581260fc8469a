"""V2VNet-robust's corrections and weights, and that they can be learnt."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cobevglue.alignment.given import GivenLocalisation
from cobevglue.alignment.group import Observation
from cobevglue.alignment.v2vnet_robust import V2VNetRobustPoses
from cobevglue.fusion import FUSION_METHODS, FusionSample
from cobevglue.fusion.v2vnet import V2VNet
from cobevglue.fusion.v2vnet_robust import V2VNetRobust, apply_correction, true_correction
from cobevglue.perception import (
    DetectionLoss,
    Perception,
    PerceptionOutput,
    PointPillars,
    TargetBatch,
    assign_targets,
    collate_targets,
)
from cobevglue.se2 import SE2
from cobevglue.typing import FloatArray

from . import checks

DETECTOR = checks.small_detector()
WIDE = checks.SMALL.model_copy(update={"x_range": (-38.4, 38.4), "y_range": (-25.6, 25.6)})
"""Room enough to be out of place in."""
NOISE = (0.8, 0.8, math.radians(6.0))
"""Standard deviation of x, y [m] and yaw [rad] of a relative pose."""


def make_method(detector: PointPillars = DETECTOR, seed: int = 1) -> V2VNetRobust:
    method = checks.seeded(V2VNetRobust, detector, seed)
    method.up.weight.data.mul_(500.0)  # at first they are close to 0
    return method


def without_corrections() -> V2VNetRobust:
    """Where all cells look the same, there is nothing to correct a pose by."""
    method = make_method()
    torch.nn.init.zeros_(method.matching.embedding.weight)
    return method


def with_messages_weighed(logit: float) -> V2VNetRobust:
    """All messages of others have the same weight."""
    method = make_method()
    last = method.matching.trust[-1]
    assert isinstance(last, torch.nn.Linear)
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.constant_(last.bias, logit)
    return method


def see(detector: PointPillars, world_SE2_agent: SE2, landmarks: FloatArray) -> PerceptionOutput:
    """What an agent sees of poles at landmarks (K, 2) [m] in the world."""
    poles = np.concatenate([landmarks + (0.1 * i, 0.0) for i in range(3)])
    xy = np.repeat(world_SE2_agent.inverse().apply(poles), 8, axis=0)
    z = np.tile(np.linspace(-2.0, 0.5, 8), len(poles))
    return Perception(detector).step(np.column_stack([xy, z, np.zeros(len(z))]).astype(np.float32))


def quick_norms(module: torch.nn.Module) -> None:
    """Normalisation that knows its input after a few batches."""
    for norm in module.modules():
        if isinstance(norm, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d):
            norm.momentum = 0.5


def wide_detector() -> PointPillars:
    """Random weights, whose features differ from place to place."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        detector = PointPillars(WIDE).eval()
    quick_norms(detector)
    clouds = [torch.from_numpy(view.points) for view in make_scene(detector, 99).observations]
    detector.train()
    with torch.no_grad():
        for _ in range(6):
            detector(clouds)
    return detector.eval()


def make_scene(detector: PointPillars, seed: int) -> FusionSample:
    """Sixty poles, seen by the ego and another."""
    rng = np.random.default_rng([3, seed])
    landmarks = rng.uniform((-36.0, -24.0), (36.0, 24.0), (60, 2))
    poses = [SE2(), SE2(*(rng.uniform(-1.0, 1.0, 3) * (10.0, 6.0, 0.5)))]
    return FusionSample([see(detector, pose, landmarks) for pose in poses], poses, poses)


def with_noise(sample: FusionSample, rng: np.random.Generator) -> FusionSample:
    ego, other = sample.true_ego_SE2_agent
    return replace(sample, ego_SE2_agent=[ego, SE2(*(rng.normal(size=3) * NOISE)) @ other])


def world_SE3(pose: SE2) -> FloatArray:
    matrix = np.eye(4)
    matrix[np.ix_([0, 1, 3], [0, 1, 3])] = pose.matrix()
    return matrix


def no_targets(method: V2VNetRobust, samples: int) -> TargetBatch:
    none = assign_targets(np.zeros((0, 7)), np.zeros(0, dtype=bool), method.anchors)
    return collate_targets([none] * samples, len(method.anchors))


_METRES, _TURN = st.floats(-50.0, 50.0), st.floats(-3.0, 3.0)


@given(st.tuples(_METRES, _METRES, _TURN), st.tuples(_METRES, _METRES, _TURN))
def test_true_correction_gives_the_true_pose(believed: tuple[float, ...], true: tuple[float, ...]) -> None:
    pose, wanted = SE2(*believed), SE2(*true)
    found = apply_correction(pose, true_correction(pose, wanted).tolist())
    assert found.error_to(wanted) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_a_correction_shifts_and_turns_about_the_middle() -> None:
    pose = SE2(20.0, 10.0, 0.3)
    np.testing.assert_allclose(apply_correction(pose, [1.5, -0.5, 0.0]).translation, [21.5, 9.5])
    turned = apply_correction(pose, [0.0, 0.0, math.pi / 2])
    np.testing.assert_allclose(turned.translation, [10.0 - 5.0, 5.0 + 10.0], atol=1e-9)
    assert turned.yaw == pytest.approx(0.3 + math.pi / 2)


def test_message_weights_interpolate_to_v2vnet() -> None:
    ego, other = checks.view(DETECTOR, 0), checks.view(DETECTOR, 1)
    mute, loud = with_messages_weighed(-1e4), with_messages_weighed(1e4)
    heard = [checks.sent(mute, other, checks.POSES[0])]
    checks.assert_same_boxes(mute.fuse(ego, heard), mute.fuse(ego, []), atol=1e-6)
    plain = V2VNet(DETECTOR).eval()
    own = loud.state_dict()
    plain.load_state_dict({name: own[name] for name in plain.state_dict()})
    checks.assert_same_boxes(loud.fuse(ego, heard), plain.fuse(ego, heard), atol=1e-6)


def test_agents_alone_have_no_pose_to_learn() -> None:
    method = make_method()
    alone = checks.sample_of([checks.view(DETECTOR, 0)])
    terms = method.loss([alone], no_targets(method, 1), DetectionLoss(checks.SMALL))
    assert torch.isfinite(terms["total"])
    assert terms["pose"].item() == terms["attention"].item() == 0.0


def test_every_second_sample_has_the_noise() -> None:
    """With a network that corrects nothing, the loss of a true pose is 0."""
    method, loss = without_corrections(), DetectionLoss(checks.SMALL)
    known = checks.sample_of([checks.view(DETECTOR, 0), checks.view(DETECTOR, 1)])
    noisy = with_noise(known, np.random.default_rng(0))

    def pose_loss(*samples: FusionSample) -> float:
        return method.loss(list(samples), no_targets(method, len(samples)), loss)["pose"].item()

    assert pose_loss(known, known) == pytest.approx(0.0, abs=1e-9)
    assert pose_loss(known, noisy) == pytest.approx(0.0, abs=1e-9)
    assert pose_loss(noisy, known) > 0.01


@pytest.fixture(scope="module")
def learnt() -> tuple[V2VNetRobust, V2VNetRobust, list[FusionSample]]:
    """A method, the same after a few steps, and what it was trained on with other noise."""
    detector = wide_detector()
    before, after = make_method(detector).train(), make_method(detector).train()
    quick_norms(after)
    scenes = [make_scene(detector, seed) for seed in range(4)]
    rng = np.random.default_rng(1)
    optimizer, loss = torch.optim.AdamW(after.parameters(), lr=1e-2), DetectionLoss(WIDE)
    for _ in range(40):
        samples = [with_noise(scene, rng) for scene in scenes]
        terms = after.loss(samples, no_targets(after, len(samples)), loss)
        optimizer.zero_grad()
        (terms["pose"] + terms["attention"]).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    return before, after, [with_noise(scene, rng) for scene in scenes * 4]


def test_corrections_and_weights_are_learnt(learnt: tuple[V2VNetRobust, V2VNetRobust, list[FusionSample]]) -> None:
    *methods, samples = learnt
    with torch.no_grad():
        terms = [m.loss(samples, no_targets(m, len(samples)), DetectionLoss(WIDE)) for m in methods]
    assert terms[1]["pose"] < 0.5 * terms[0]["pose"]
    assert terms[1]["attention"] < 0.8 * terms[0]["attention"]


def test_claimed_poses_are_brought_nearer(learnt: tuple[V2VNetRobust, V2VNetRobust, list[FusionSample]]) -> None:
    _, method, samples = learnt
    aligner = V2VNetRobustPoses(method.eval())
    errors = []
    for sample in samples:
        observations = {
            str(i): Observation(features=view.features, pose=world_SE3(pose))
            for i, (view, pose) in enumerate(zip(sample.observations, sample.ego_SE2_agent, strict=True))
        }
        found = aligner.align_group("0", observations)["1"].ego_SE2_other
        assert found is not None
        true = sample.true_ego_SE2_agent[1]
        errors.append([*sample.ego_SE2_agent[1].error_to(true), *found.error_to(true)])
    before, before_yaw, after, after_yaw = np.median(errors, axis=0)
    assert after < 0.6 * before
    assert after_yaw < 0.4 * before_yaw


def test_correct_poses_stay_as_claimed() -> None:
    agents = {"ego": SE2(50.0, 20.0, 2.0), "b": SE2(53.0, 21.0, 1.7), "c": SE2(48.0, 22.0, -2.5)}
    observations = {}
    for number, (name, world_SE2_agent) in enumerate(agents.items()):
        features = checks.view(DETECTOR, number).features
        observations[name] = Observation(features=features, pose=world_SE3(world_SE2_agent))
    found = V2VNetRobustPoses(without_corrections()).align_group("ego", observations)
    given = GivenLocalisation().align_group("ego", observations)
    assert found.keys() == given.keys() == {"b", "c"}
    for name in found:
        kept, claimed = found[name].ego_SE2_other, given[name].ego_SE2_other
        assert kept is not None
        assert claimed is not None
        assert kept.error_to(claimed) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_ego_alone_has_no_matches() -> None:
    observation = Observation(features=checks.view(DETECTOR, 0).features, pose=np.eye(4))
    assert V2VNetRobustPoses(make_method()).align_group("ego", {"ego": observation}) == {}


def test_it_goes_by_the_name_that_users_type() -> None:
    assert FUSION_METHODS["v2vnet-robust"] is V2VNetRobust
    assert V2VNetRobust.usual_aligner == "v2vnet-robust"
