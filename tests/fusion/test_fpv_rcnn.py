"""FPV-RCNN: keypoints lie in proposals, proposals of one object become one, and the second stage refines boxes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue import Boxes
from cobevglue.fusion import FusionSample, Received, fusion_class
from cobevglue.fusion.fpv_rcnn import FPVRCNN, _Message
from cobevglue.fusion.fpv_rcnn_keypoints import select_keypoints, spread
from cobevglue.fusion.fpv_rcnn_proposals import decode_refinement, encode_refinement, merge_proposals
from cobevglue.fusion.fpv_rcnn_roi import RoIHead
from cobevglue.messages import encode_arrays
from cobevglue.perception import DetectionLoss, TargetBatch, assign_targets, collate_targets
from cobevglue.se2 import SE2
from cobevglue.typing import Float32Array, FloatArray

from . import checks

DETECTOR = checks.small_detector()
CAR = [4.4, 1.9, 1.6]


def cars(*rows: tuple[float, float, float, float]) -> Boxes:
    """Cars at x, y [m] with a yaw [rad] and a score."""
    x, y, yaw, score = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    return Boxes(np.column_stack([x, y, np.full(len(x), -1.0)]), np.tile(CAR, (len(x), 1)), yaw, score)


def pose_of(boxes: Boxes, row: int) -> SE2:
    return SE2(boxes.center[row, 0], boxes.center[row, 1], boxes.yaw[row])


def scattered(seed: int, count: int = 4000) -> Float32Array:
    return np.random.default_rng(seed).uniform([-12, -6, -2, 0], [12, 6, 0.5, 1], (count, 4)).astype(np.float32)


# Keypoints


def test_few_proposal_points_are_all_keypoints() -> None:
    points, margin = scattered(0), 0.3
    boxes = cars((3.0, 1.0, 0.7, 0.9), (4.0, 2.0, 2.0, 0.5), (-8.0, -4.0, -1.0, 0.2))
    inside = np.zeros(len(points), dtype=bool)
    for row in range(len(boxes)):
        box_SE2_lidar = pose_of(boxes, row).inverse()
        local = np.abs(box_SE2_lidar.apply(points[:, :3] - np.array([0.0, 0.0, -1.0])))
        inside |= (local <= np.array(CAR) / 2 + margin).all(axis=1)
    assert 100 < inside.sum() < 1000
    np.testing.assert_array_equal(select_keypoints(points, boxes, margin, 1024), points[inside, :3])


@pytest.mark.parametrize("budget", [1, 7, 100])
def test_keypoints_keep_to_the_budget(budget: int) -> None:
    points = scattered(1)
    boxes = cars((3.0, 1.0, 0.7, 0.9), (-8.0, -4.0, -1.0, 0.2))
    every, some = (select_keypoints(points, boxes, 0.0, number) for number in (10_000, budget))
    assert len(some) <= budget < len(every)
    assert len(some) >= budget / 3  # and use it
    assert {tuple(p) for p in some} <= {tuple(p) for p in every}


def test_keypoints_are_evenly_spread() -> None:
    """Of a dense and a thin cluster of equal size, about as many are taken."""
    rng = np.random.default_rng(0)
    dense, thin = rng.uniform(-1, 1, (5000, 3)), rng.uniform(-1, 1, (400, 3)) + np.array([50.0, 0.0, 0.0])
    rows = spread(np.concatenate([dense, thin]).astype(np.float32), 300)
    few, many = sorted([np.count_nonzero(rows < 5000), np.count_nonzero(rows >= 5000)])
    assert many < 1.6 * few


def test_no_proposals_no_keypoints() -> None:
    assert select_keypoints(scattered(0), cars(), 0.3, 100).shape == (0, 3)
    assert select_keypoints(np.zeros((0, 4), np.float32), cars((0, 0, 0, 1)), 0.3, 100).shape == (0, 3)


# Proposals


def test_equal_boxes_merge_to_themselves() -> None:
    box = cars((3.0, 1.0, 3.1, 0.6))
    merged, counts = merge_proposals(Boxes.concatenate([box, box]), 0.15)
    np.testing.assert_allclose(merged.bev, box.bev)
    np.testing.assert_allclose(merged.center[:, 2], -1.0)
    assert merged.score == pytest.approx([0.6])
    assert counts.tolist() == [2]


def test_merged_boxes_are_means_weighted_by_score() -> None:
    merged, counts = merge_proposals(cars((0.0, 0.0, 0.1, 0.6), (1.0, 0.3, 0.3, 0.2)), 0.15)
    np.testing.assert_allclose(merged.bev, [[0.25, 0.075, CAR[0], CAR[1], 0.15]], atol=1e-12)
    assert merged.score == pytest.approx([0.6])
    assert counts.tolist() == [2]


@pytest.mark.parametrize(
    ("rows", "yaw"),
    [
        ([(0, 0, 0.1, 0.5), (0, 0, 0.1 + math.pi, 0.3)], 0.1),  # the surer one faces right
        ([(0, 0, 0.1, 0.5), (0, 0, 0.1 + math.pi, 0.3), (0, 0, 0.1 - math.pi, 0.3)], 0.1 - math.pi),  # two outvote it
        ([(0, 0, math.pi - 0.1, 0.5), (0, 0, -math.pi + 0.1, 0.5)], -math.pi),  # either side of the cut
        ([(0, 0, math.pi / 2 - 0.1, 0.5), (0, 0, -math.pi / 2 + 0.1, 0.4)], math.pi / 2 - 0.1 + 0.2 * 4 / 9),
    ],
)
def test_headings_are_made_consistent(rows: list[tuple[float, float, float, float]], yaw: float) -> None:
    merged, _ = merge_proposals(cars(*rows), 0.15)
    assert len(merged) == 1
    assert math.remainder(merged.yaw[0] - yaw, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


def test_boxes_apart_stay_apart_best_first() -> None:
    boxes = cars((0, 0, 0, 0.2), (10, 0, 1, 0.9), (0, 5, 0, 0.5), (0, 2, 0, 0.1))
    merged, counts = merge_proposals(boxes, 0.15)
    np.testing.assert_allclose(merged.bev, boxes.bev[[1, 2, 0, 3]])
    assert counts.tolist() == [1, 1, 1, 1]


def test_nothing_merges_to_nothing_and_scores_are_needed() -> None:
    merged, counts = merge_proposals(cars(), 0.15)
    assert len(merged) == len(counts) == 0
    assert merged.score is not None
    with pytest.raises(ValueError, match="score"):
        merge_proposals(cars((0, 0, 0, 1)).replace(score=None), 0.15)


numbers = st.floats(-1.0, 1.0)


@settings(max_examples=50, deadline=None)
@given(st.lists(numbers, min_size=7, max_size=7), numbers, st.floats(-4.0, 4.0))
def test_refinements_lead_to_the_box(change: list[float], x: float, yaw: float) -> None:
    proposal = cars((30 * x, 5.0, yaw, 0.7))
    shift, ratio, turn = change[:3], np.exp(change[3:6]), 1.5 * change[6]
    box = proposal.replace(center=proposal.center + shift, size=proposal.size * ratio, yaw=proposal.yaw + turn)
    back = decode_refinement(encode_refinement(box, proposal), proposal)
    np.testing.assert_allclose(back.center, box.center, atol=1e-9)
    np.testing.assert_allclose(back.size, box.size)
    assert math.remainder(back.yaw[0] - box.yaw[0], 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


def test_refinements_are_in_proposal_axes_keeping_direction() -> None:
    proposal, box = cars((0, 0, math.pi / 2, 1)), cars((0, 1, -math.pi / 2 + 0.1, 1))
    diagonal = math.hypot(*CAR[:2])
    np.testing.assert_allclose(encode_refinement(box, proposal), [[1 / diagonal, 0, 0, 0, 0, 0, 0.1]], atol=1e-12)


# The second stage


def second_stage(grid: tuple[int, int, int] = (3, 2, 2)) -> RoIHead:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(2)
        return RoIHead(4, 0.3, grid).double()


def roi_inputs(boxes: Boxes, points: FloatArray) -> tuple[torch.Tensor, torch.Tensor]:
    rows = np.column_stack([boxes.center, boxes.size, boxes.yaw])
    return torch.from_numpy(rows), torch.from_numpy(points)


def test_a_cell_is_the_maximum_over_its_keypoints() -> None:
    boxes = cars((3.0, 1.0, 0.7, 0.9), (4.0, 2.0, 2.0, 0.5), (40.0, 0.0, 0.0, 0.5))
    points = scattered(2, 1500)[:, :3].astype(np.float64)
    features, headings = np.random.default_rng(0).normal(size=(1500, 4)), np.linspace(-3.0, 9.0, 1500)
    head = second_stage()
    weights = head.feature.weight.detach().numpy().reshape(5, 32, 4)
    with torch.no_grad():
        found = head.pool(*roi_inputs(boxes, points), *map(torch.from_numpy, (headings, features))).numpy()
        expected = np.zeros((3, 12, 32))
        for row in range(3):
            local = pose_of(boxes, row).inverse().apply(points + np.array([0.0, 0.0, 1.0]))
            for k, p in enumerate(local):
                share = p / (np.array(CAR) + 0.6) + 0.5
                if (share >= 0).all() and (share < 1).all():
                    i, j, z = np.floor(share * [3, 2, 2]).astype(int)
                    angle = boxes.yaw[row] - headings[k]
                    waves = [1.0, np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)]
                    told = np.einsum("w,wcf,f->c", waves, weights, features[k])
                    told = torch.from_numpy(told) + head.place(torch.from_numpy(np.concatenate([p, share - 0.5])))
                    cell = (i * 2 + j) * 2 + z
                    expected[row, cell] = np.maximum(expected[row, cell], head.point(told).numpy())
    assert (expected[:2].max(axis=(1, 2)) > 0).all()
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_moving_everything_together_changes_nothing() -> None:
    boxes, points = cars((3.0, 1.0, 0.7, 0.9), (4.0, 2.0, 2.0, 0.5)), scattered(2, 500)[:, :3].astype(np.float64)
    features = torch.from_numpy(np.random.default_rng(0).normal(size=(500, 4)))
    headings = torch.linspace(-3.0, 9.0, 500, dtype=torch.float64)
    move = SE2(-30.0, 12.0, 2.5)
    head = second_stage()
    here = head.pool(*roi_inputs(boxes, points), headings, features)
    there = head.pool(*roi_inputs(boxes.transform(move), move.apply(points)), headings + move.yaw, features)
    torch.testing.assert_close(here, there)


def test_initial_scores_and_boxes_are_the_proposals() -> None:
    boxes = cars((3.0, 1.0, 0.7, 0.9), (4.0, 2.0, 2.0, 0.2))
    rows, points = roi_inputs(boxes, scattered(2, 500)[:, :3].astype(np.float64))
    score, features = torch.from_numpy(np.array(boxes.score)), torch.zeros(500, 4, dtype=torch.float64)
    ones, zeros = torch.ones(2, dtype=torch.float64), torch.zeros(500, dtype=torch.float64)
    logits, refinement = second_stage()(rows, score, ones, points, zeros, features)
    torch.testing.assert_close(logits.sigmoid(), score, atol=0.02, rtol=0.0)
    assert refinement.abs().max() < 0.05


def test_second_stage_learns_to_refine_boxes() -> None:
    """Proposals are off by up to half a metre; points on the true boxes tell by how much."""
    rng = np.random.default_rng(0)

    def scene(count: int) -> tuple[tuple[torch.Tensor, ...], torch.Tensor]:
        truth = cars(*[(20.0 * i, 0.0, yaw, 0.5) for i, yaw in enumerate(rng.uniform(-3, 3, count))])
        points = []
        for box in range(count):
            p = rng.uniform(-0.5, 0.5, (40, 3)) * CAR
            side = rng.integers(2, size=40)
            p[np.arange(40), side] = np.sign(p[np.arange(40), side]) * np.array(CAR)[side] / 2  # on its four sides
            p = pose_of(truth, box).apply(p)
            points.append(p + np.array([0.0, 0.0, -1.0]))
        off = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), np.zeros(count)])
        proposals = truth.replace(center=truth.center + off, yaw=truth.yaw + rng.uniform(-0.1, 0.1, count))
        rows = np.column_stack([proposals.center, proposals.size, proposals.yaw])
        nothing = np.zeros((40 * count, 1))
        values = (rows, proposals.score, np.ones(count), np.concatenate(points), nothing[:, 0], nothing)
        tensors = tuple(torch.tensor(v, dtype=torch.float32) for v in values)
        return tensors, torch.tensor(encode_refinement(truth, proposals), dtype=torch.float32)

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        head = RoIHead(1, 0.6)
    optimizer = torch.optim.Adam(head.parameters(), lr=3e-3)
    for _ in range(60):
        inputs, aim = scene(32)
        optimizer.zero_grad()
        torch.nn.functional.smooth_l1_loss(head(*inputs)[1], aim, beta=0.02).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    inputs, aim = scene(64)
    with torch.no_grad():
        after = (head(*inputs)[1] - aim)[:, :2].norm(dim=1).mean()
    assert after < 0.5 * aim[:, :2].norm(dim=1).mean()


# The method


def method_with_weights(seed: int = 1) -> FPVRCNN:
    method = checks.seeded(FPVRCNN, DETECTOR, seed)
    method.proposal_score = 0.0
    return method


def test_keypoint_features_are_sampled_from_the_map() -> None:
    """A map that holds the coordinates of its cells' centres says of a point where it is."""
    method = method_with_weights()
    x, y = np.meshgrid(-12.8 + 0.8 * (np.arange(32) + 0.5), -6.4 + 0.8 * (np.arange(16) + 0.5))
    points = np.array([[1.3, -2.0, 0.5], [-12.0, 5.9, -1.0], [0.0, 0.0, 0.0]], np.float32)
    found = method._at(points, torch.from_numpy(np.stack([x, y])))
    np.testing.assert_allclose(found.numpy(), points[:, :2], atol=1e-5)
    assert (method._at(np.array([[40.0, 0.0, 0.0]], np.float32), torch.ones(2, 16, 32)) == 0).all()


def test_a_message_is_proposals_and_keypoints_in_them() -> None:
    seen = checks.view(DETECTOR, 0)
    message = method_with_weights().message(seen)
    rows = message["proposals"].astype(np.float64)
    proposals = Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6], rows[:, 7])
    checks.assert_same_boxes(proposals, seen.detections, atol=1e-5)  # before training the head is the detector's
    keypoints = message["keypoints"]
    assert 0 < len(keypoints) < len(seen.points)
    assert {tuple(p) for p in keypoints} <= {tuple(p) for p in seen.points[:, :3]}
    as_points = np.column_stack([keypoints, np.zeros(len(keypoints), np.float32)])
    np.testing.assert_array_equal(select_keypoints(as_points, proposals, 0.31, 10_000), keypoints)
    assert message["features"].shape == (len(keypoints), 32)
    assert message["features"].dtype == np.float16


def test_a_message_is_bounded_however_dense_the_cloud() -> None:
    method = method_with_weights()
    sizes = [len(encode_arrays(method.message(checks.view(DETECTOR, 0, count)))) for count in (600, 30_000)]
    assert sizes[0] < sizes[1] <= 20 * 32 + 1024 * (12 + 64) + 100


def test_proposals_below_the_score_are_not_sent() -> None:
    seen = checks.view(DETECTOR, 0)
    method = method_with_weights()
    scores = seen.detections.score
    assert scores is not None
    method.proposal_score = float(scores[2:4].mean())
    assert len(method.message(seen)["proposals"]) == 3


def test_proposals_and_keypoints_move_with_their_agent() -> None:
    """Twice the same agent, once where it is and once turned away and told so, is the same."""
    ego = checks.view(DETECTOR, 0)
    method = method_with_weights()
    message = checks.sent(method, ego, SE2()).content
    turn = SE2(30.0, -4.0, 1.0)
    rows = message["proposals"].astype(np.float64)
    moved = Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6]).transform(turn.inverse())
    proposals = np.column_stack([moved.center, moved.size, moved.yaw, rows[:, 7]]).astype(np.float32)
    keypoints = turn.inverse().apply(message["keypoints"]).astype(np.float32)
    away = Received({**message, "proposals": proposals, "keypoints": keypoints}, turn)
    assert method._decode(away).heading == pytest.approx(1.0)
    here = method.fuse(ego, [checks.sent(method, ego, SE2())])
    wrong = method.fuse(ego, [Received(away.content, SE2(31.0, -4.0, 1.0))])
    assert len(wrong) != len(here) or np.abs(wrong.bev - here.bev).max() > 0.1
    # The features are those of an agent that was not turned, and say so: 1 rad too much, which untrained layers that
    # hardly refine make little of.
    checks.assert_same_boxes(method.fuse(ego, [away]), here, atol=0.02)


def test_uncovered_cells_stay_unchanged() -> None:
    """Of an agent far away everything is far away; what the ego found is not touched."""
    ego, other = checks.view(DETECTOR, 0), checks.view(DETECTOR, 1)
    method = method_with_weights()
    method.detection = method.detection.model_copy(update={"max_detections": 100})
    alone, together = method.fuse(ego, []), method.fuse(ego, [checks.sent(method, other, checks.FAR)])
    near = together[np.abs(together.center[:, 0]) < 100.0]
    assert len(near) < len(together)
    checks.assert_same_boxes(near, alone)


def test_nothing_to_see_is_no_special_case() -> None:
    method = method_with_weights()
    method.proposal_score = 1.0
    ego = checks.view(DETECTOR, 0)
    message = checks.sent(method, checks.view(DETECTOR, 1), checks.POSES[0])
    assert len(message.content["proposals"]) == len(message.content["keypoints"]) == 0
    boxes = method.fuse(ego, [message])
    assert len(boxes) == 0
    assert boxes.score is not None


def targets_of(boxes: Boxes, method: FPVRCNN) -> TargetBatch:
    rows = np.column_stack([boxes.center, boxes.size, boxes.yaw])
    return collate_targets([assign_targets(rows, np.zeros(len(rows), bool), method.anchors)], len(method.anchors))


def test_the_loss_is_that_of_scores_and_boxes() -> None:
    """Before training, with the ego's own proposals as the truth: boxes are right, scores should all be 1."""
    seen = checks.view(DETECTOR, 0)
    method = method_with_weights()
    sample = checks.sample_of([seen])
    truth = seen.detections.replace(score=None)
    loss = DetectionLoss(method.config)
    with torch.no_grad():
        exact = method.loss([replace(sample, truth=truth)], targets_of(truth, method), loss)
        none = method.loss([replace(sample, truth=Boxes.empty())], targets_of(Boxes.empty(), method), loss)
    scores = seen.detections.score
    assert scores is not None
    assert exact["second_score"].item() == pytest.approx(-np.log(scores).mean(), rel=0.05)
    assert exact["second_box"].item() < 0.05
    assert none["second_score"].item() == pytest.approx(-np.log1p(-scores).mean(), rel=0.05)
    assert none["second_box"].item() == 0.0


def test_both_halves_of_a_bus_are_trained() -> None:
    """Objects have identities, of which there must be one each: not so where an object stands for two proposals."""
    method, loss = method_with_weights(), DetectionLoss(checks.SMALL)
    halves = cars((-2.3, 0.0, 0.0, 0.9), (2.3, 0.0, 0.0, 0.8))
    bus = Boxes([[0.0, 0.0, -1.0]], [[9.2, 1.9, 1.6]], [0.0], track_id=[7])
    told = _Message(halves, np.zeros((0, 3), np.float32), torch.zeros(0, 32))
    _, _, proposals, right = method._second_loss([told], bus, loss)
    assert (int(proposals), int(right)) == (2, 2)


def test_score_target_grows_from_quarter_to_three_quarters() -> None:
    seen = checks.view(DETECTOR, 0)
    method = method_with_weights()
    scores = seen.detections.score
    assert scores is not None
    method.proposal_score = float(scores[:2].mean())  # one proposal
    loss = DetectionLoss(method.config)
    for overlap, wanted in ((0.2, 0.0), (0.4, 0.3), (0.7, 0.9), (0.9, 1.0)):
        truth = seen.detections[:1].replace(score=None)
        truth = truth.replace(size=truth.size / [overlap, 1.0, 1.0])
        sample = replace(checks.sample_of([seen]), truth=truth)
        with torch.no_grad():
            found = method.loss([sample], targets_of(truth, method), loss)["second_score"].item()
        assert found == pytest.approx(-wanted * np.log(scores[0]) - (1 - wanted) * np.log1p(-scores[0]), rel=0.05)


def test_the_second_stage_needs_the_truth() -> None:
    method = method_with_weights()
    sample = FusionSample([checks.view(DETECTOR, 0)], [SE2()], [SE2()])
    with pytest.raises(ValueError, match="truth"):
        method.loss([sample], targets_of(Boxes.empty(), method), DetectionLoss(method.config))


def test_it_is_used_as_its_paper_does() -> None:
    assert fusion_class("fpv-rcnn") is FPVRCNN
    assert FPVRCNN.usual_aligner == "fpv-rcnn"
