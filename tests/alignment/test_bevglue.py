"""BEVGlue on single frames: what it finds, what it refuses, and what must not change the answer."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue import SE2, BEVGlue, BEVGlueConfig, Boxes
from cobevglue.alignment import Alignment
from cobevglue.typing import FloatArray

from .scenes import (
    Pair,
    cars,
    content,
    detected,
    error_at,
    junction,
    mahalanobis,
    mirrored,
    pair_of_views,
    pairs_of,
    random_boxes,
    random_pose,
    with_ids,
)

pytestmark = pytest.mark.usefixtures("warm_kernels")

FAR = 500.0
"""How far frames are moved [m]."""


def align(ego: Boxes, other: Boxes, **options: float | bool) -> Alignment:
    """One frame, seen by a new BEVGlue."""
    return BEVGlue(BEVGlueConfig.model_validate(options)).align(ego, other)


def junction_frames(step: int = 4) -> list[Pair]:
    """Frames of eight simulated junctions, with a detector's errors."""
    return [
        Pair(
            frame.agents["car1"].boxes,
            frame.agents["car2"].boxes,
            frame.ego_SE2_other("car1", "car2"),
            frame.matches("car1", "car2"),
        )
        for seed in range(8)
        for frame in junction(seed)[::step]
    ]


def landing_covariance(alignment: Alignment, point: FloatArray) -> FloatArray:
    """(2, 2) covariance of where a point of other's frame lands in ego's."""
    assert alignment.ego_SE2_other is not None
    x, y = alignment.ego_SE2_other.rotation @ point
    jacobian = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])
    return np.asarray(jacobian @ alignment.covariance @ jacobian.T)


# What it finds


@pytest.mark.parametrize("common", [6, 8, 12])
@pytest.mark.parametrize("clutter", [0, 8])
def test_a_clear_frame_is_accepted_and_right(common: int, clutter: int) -> None:
    for seed in range(30):
        scene = pair_of_views(common, seed, clutter, clutter)
        alignment = align(scene.ego, scene.other)
        assert alignment.ego_SE2_other is not None, f"seed {seed}: {alignment.reason}"
        assert error_at(alignment.ego_SE2_other, scene.ego_SE2_other, scene.other) < 1.0, seed
        assert alignment.ego_SE2_other.error_to(scene.ego_SE2_other)[1] < math.radians(1.0), seed
        true = {(int(m), int(n)) for m, n in scene.matches}
        assert len(pairs_of(alignment) & true) >= common - 1, seed
        assert len(pairs_of(alignment) - true) <= 1, seed


def test_the_direction_of_the_pose() -> None:
    """Other stands at (30, 4) in ego's frame and looks back at it."""
    ego = cars([(10, 3, 0), (14, -8, 90), (25, 12, 30), (40, 0, 180), (35, -15, 60), (5, 20, -45)])
    other = cars([(20, 1, 180), (16, 12, -90), (5, -8, -150), (-10, 4, 0), (-5, 19, -120), (25, -16, 135)])
    alignment = align(ego, other)
    assert alignment.ego_SE2_other is not None
    distance, turn = alignment.ego_SE2_other.error_to(SE2(30.0, 4.0, math.pi))
    assert distance < 1e-6
    assert turn < 1e-8
    assert pairs_of(alignment) == {(i, i) for i in range(6)}


@given(seed=st.integers(0, 10**6), n=st.integers(6, 12))
@settings(max_examples=50, deadline=None)
def test_without_errors_the_pose_is_exact(seed: int, n: int) -> None:
    scene = pair_of_views(n, seed, noise=(0.0, 0.0, 0.0, 0.0))
    alignment = align(scene.ego, scene.other)
    assert error_at(alignment.ego_SE2_other, scene.ego_SE2_other, scene.other) < 1e-8
    assert pairs_of(alignment) == {(int(m), int(k)) for m, k in scene.matches}


@pytest.mark.parametrize("share", [0.2, 0.4])
def test_turned_headings_do_not_matter(share: float) -> None:
    """A detector that sees the rear for the front, in one list."""
    for seed in range(30):
        scene = pair_of_views(8, seed, 3, 3)
        turned = np.random.default_rng([seed, 2, 0]).random(len(scene.ego)) < share
        alignment = align(scene.ego.replace(yaw=scene.ego.yaw + np.pi * turned), scene.other)
        assert error_at(alignment.ego_SE2_other, scene.ego_SE2_other, scene.other) < 1.0, seed


def test_a_junction_is_mostly_found_and_rarely_wrong() -> None:
    accepted, wrong = 0, 0
    frames = junction_frames()
    for scene in frames:
        alignment = align(scene.ego, scene.other)
        accepted += alignment.accepted
        wrong += alignment.accepted and error_at(alignment.ego_SE2_other, scene.ego_SE2_other, scene.other) > 3.0
    assert accepted > 0.5 * len(frames)
    assert wrong <= 0.05 * accepted


# What must not change the answer


def test_pose_is_equivariant_to_rigid_motion() -> None:
    """ego' = A ego and other' = B other give A pose B^-1."""
    for seed, scene in enumerate(junction_frames()):
        rng = np.random.default_rng([seed, 3, 0])
        (x, y), b = rng.uniform(-FAR, FAR, 2), random_pose(rng, FAR)
        a = SE2(x, y, 0.0)
        here, there = align(scene.ego, scene.other), align(scene.ego.transform(a), scene.other.transform(b))
        assert here.accepted == there.accepted
        assert pairs_of(here) == pairs_of(there)
        assert there.evidence == pytest.approx(here.evidence, abs=1e-6)
        if here.ego_SE2_other is not None:
            expected = a @ here.ego_SE2_other @ b.inverse()
            assert error_at(there.ego_SE2_other, expected, scene.other.transform(b)) < 1e-6


@pytest.mark.parametrize(("rounds", "tolerance"), [(None, 0.02), (30, 1e-6)])
def test_turning_ego_turns_the_pose(rounds: int | None, tolerance: float) -> None:
    """Another order of the seeds may lead to the same pose by another way: equal to 1e-6 once refits have settled."""
    options = {} if rounds is None else {"rounds": rounds}
    frames, verdicts = junction_frames(), 0
    for seed, scene in enumerate(frames):
        rng = np.random.default_rng([seed, 4, 0])
        a, b = random_pose(rng, FAR), random_pose(rng, FAR)
        here = align(scene.ego, scene.other, **options)
        there = align(scene.ego.transform(a), scene.other.transform(b), **options)
        verdicts += here.accepted == there.accepted
        if here.ego_SE2_other is not None and there.ego_SE2_other is not None:
            expected = a @ here.ego_SE2_other @ b.inverse()
            assert error_at(there.ego_SE2_other, expected, scene.other.transform(b)) < tolerance
            assert pairs_of(here) == pairs_of(there)
    assert verdicts >= 0.97 * len(frames)


@given(seed=st.integers(0, 10**6), x=st.floats(-1e6, 1e6), y=st.floats(-1e6, 1e6), yaw=st.floats(-10.0, 10.0))
@settings(max_examples=40, deadline=None)
def test_frames_may_have_their_origin_anywhere(seed: int, x: float, y: float, yaw: float) -> None:
    """Map coordinates of a million metres lose nothing: the boxes land where they did, as surely as they did."""
    scene, b = pair_of_views(8, seed, 2, 2), SE2(x, y, yaw)
    here, there = align(scene.ego, scene.other), align(scene.ego, scene.other.transform(b))
    assert here.ego_SE2_other is not None
    assert there.ego_SE2_other is not None
    moved = b.apply(scene.other.center[:, :2])
    np.testing.assert_allclose(
        there.ego_SE2_other.apply(moved), here.ego_SE2_other.apply(scene.other.center[:, :2]), atol=1e-6
    )
    near = landing_covariance(here, scene.other.center[0, :2])
    far = landing_covariance(there, moved[0])
    np.testing.assert_allclose(far, near, rtol=0.01, atol=1e-4)


@given(seed=st.integers(0, 10**6), common=st.integers(0, 8), clutter=st.integers(0, 6))
@settings(max_examples=60, deadline=None)
def test_the_order_of_the_rows_does_not_matter(seed: int, common: int, clutter: int) -> None:
    scene = pair_of_views(common, seed, clutter, clutter)
    rng = np.random.default_rng([seed, 5, 0])
    p, q = rng.permutation(len(scene.ego)), rng.permutation(len(scene.other))
    here, there = align(scene.ego, scene.other), align(scene.ego[p], scene.other[q])
    assert here.accepted == there.accepted
    assert {(int(p[m]), int(q[n])) for m, n in there.matches} == pairs_of(here)
    if here.ego_SE2_other is not None:
        assert error_at(there.ego_SE2_other, here.ego_SE2_other, scene.other) < 1e-6


def test_swapping_the_roles_inverts_the_pose() -> None:
    scenes = [pair_of_views(8, seed, 3, 5) for seed in range(20)] + junction_frames()
    verdicts = 0
    for scene in scenes:
        here, there = align(scene.ego, scene.other), align(scene.other, scene.ego)
        verdicts += here.accepted == there.accepted
        if here.ego_SE2_other is not None and there.ego_SE2_other is not None:
            assert error_at(there.ego_SE2_other.inverse(), here.ego_SE2_other, scene.other) < 0.02
            assert {(m, n) for n, m in pairs_of(there)} == pairs_of(here)
    assert verdicts >= 0.97 * len(scenes)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_swapped_roles_give_the_inverse_after_refits(seed: int) -> None:
    scene = pair_of_views(8, seed, 3, 5)
    here, there = align(scene.ego, scene.other, rounds=30), align(scene.other, scene.ego, rounds=30)
    assert here.ego_SE2_other is not None
    assert there.ego_SE2_other is not None
    assert error_at(there.ego_SE2_other.inverse(), here.ego_SE2_other, scene.other) < 1e-6
    assert {(m, n) for n, m in pairs_of(there)} == pairs_of(here)


def test_non_geometric_fields_have_no_effect() -> None:
    """Heights, scores, labels and single-frame track ids say nothing about the pose."""
    scene = pair_of_views(7, 3, 2, 2)
    n = len(scene.ego)
    dressed = scene.ego.replace(
        center=scene.ego.center + (0.0, 0.0, 5.0),
        score=np.linspace(0.1, 0.9, n),
        label=np.full(n, "truck"),
        track_id=np.arange(n) * 3,
    )
    assert content(align(dressed, scene.other)) == content(align(scene.ego, scene.other))


def test_headings_count_modulo_a_full_turn() -> None:
    scene = pair_of_views(7, 3, 2, 2)
    turns = 2.0 * np.pi * np.arange(-4, len(scene.ego) - 4)
    here, there = align(scene.ego, scene.other), align(scene.ego.replace(yaw=scene.ego.yaw + turns), scene.other)
    assert here.ego_SE2_other is not None
    assert error_at(there.ego_SE2_other, here.ego_SE2_other, scene.other) < 1e-6
    assert pairs_of(here) == pairs_of(there)


# What it refuses

SHIFT = SE2(10.0, -5.0, 1.0)


def row(n: int, gap: float, yaw: float = 90.0) -> Boxes:
    return cars([(gap * i, 0.0, yaw) for i in range(n)])


def grid(n: int, gap: float) -> Boxes:
    return cars([(gap * i, 1.5 * gap * j, 0.0) for i in range(n) for j in range(n)])


AMBIGUOUS: dict[str, tuple[Boxes, Boxes]] = {
    "nobody sees anything": (Boxes.empty(), Boxes.empty()),
    "ego sees nothing": (Boxes.empty(), row(5, 6.0)),
    "other sees nothing": (row(5, 6.0), Boxes.empty()),
    "one object": (row(1, 6.0), row(1, 6.0)),
    "two objects": (row(2, 6.0), row(2, 6.0)),
    "two different objects": (cars([(0, 0, 0), (20, 7, 50)]), cars([(0, 0, 0), (20, 7, 50)])),
    "a parked row": (row(8, 2.6), row(8, 2.6)),
    "a parked row, a car longer for ego": (row(9, 2.6), row(8, 2.6)),
    "a queue with equal gaps": (row(6, 8.0, yaw=0.0), row(6, 8.0, yaw=0.0)),
    "a long queue": (row(30, 8.0, yaw=0.0), row(30, 8.0, yaw=0.0)),
    "a car park": (grid(6, 6.0), grid(6, 6.0)),
    "a large car park": (grid(8, 4.0), grid(8, 4.0)),
}


@pytest.mark.parametrize("noise_seed", [None, 0, 1])
@pytest.mark.parametrize("case", AMBIGUOUS)
def test_an_ambiguous_frame_is_refused(case: str, noise_seed: int | None) -> None:
    ego, other = AMBIGUOUS[case]
    other = other.transform(SHIFT)
    if noise_seed is not None:
        rng = np.random.default_rng([noise_seed, 6, 0])
        ego, other = detected(ego, rng), detected(other, rng)
    alignment = align(ego, other)
    assert not alignment.accepted
    assert alignment.reason


@pytest.mark.parametrize("common", [0, 1, 2])
def test_up_to_two_common_objects_are_refused(common: int) -> None:
    for clutter in (0, 8):
        accepted = []
        for seed in range(100):
            scene = pair_of_views(common, seed, clutter, clutter)
            if align(scene.ego, scene.other).accepted:
                accepted.append(seed)
        assert len(accepted) <= 2, accepted


@pytest.mark.parametrize(("n", "reach"), [(10, 40.0), (20, 50.0), (40, 60.0)])
def test_unrelated_scenes_are_refused(n: int, reach: float) -> None:
    accepted = []
    for seed in range(200):
        rng = np.random.default_rng([seed, 7, 0])
        if align(random_boxes(n, rng, reach), random_boxes(n, rng, reach)).accepted:
            accepted.append(seed)
    assert len(accepted) <= 6, accepted


def test_a_mirror_image_is_not_the_scene() -> None:
    """Seven cars without any symmetry; their mirror image has the same distances, but no rotation makes them meet."""
    ego = cars([(0, 0, 10), (15, 4, 80), (22, -9, -35), (-12, 18, 140), (-20, -7, 55), (6, 25, -100), (33, 14, 20)])
    for seed in range(20):
        moved = mirrored(ego).transform(random_pose(np.random.default_rng([seed, 8, 0])))
        assert not align(ego, moved).accepted
    assert align(ego, ego.transform(SHIFT)).accepted, "the scene itself is clear"


def test_mirrored_scenes_are_refused_like_unrelated_ones() -> None:
    accepted = []
    for seed in range(200):
        rng = np.random.default_rng([seed, 9, 0])
        boxes = random_boxes(10, rng)
        alignment = align(boxes, mirrored(boxes).transform(random_pose(rng)))
        assert len(alignment.matches) < 6, seed
        if alignment.accepted:
            accepted.append(seed)
    assert len(accepted) <= 10, accepted


# How sure it is


def test_the_covariance_is_a_covariance() -> None:
    found = 0
    for scene in junction_frames(8):
        alignment = align(scene.ego, scene.other)
        if alignment.accepted:
            found += 1
            np.testing.assert_allclose(alignment.covariance, alignment.covariance.T, rtol=1e-9, atol=1e-12)
            assert np.linalg.eigvalsh(alignment.covariance).min() > 0.0
    assert found > 0


@pytest.mark.parametrize("common", [4, 8, 15])
@pytest.mark.parametrize("strength", [0.3, 1.0])
def test_the_covariance_is_honest(common: int, strength: float) -> None:
    """With errors up to what the noise model assumes the true pose lies where the covariance says (3 on average)."""
    config = BEVGlueConfig()
    each = strength / math.sqrt(2.0)
    noise = (config.position_std * each, config.heading_std * each, 0.2, 0.05)
    squared = []
    for seed in range(150):
        scene = pair_of_views(common, seed, 3, 3, noise)
        alignment = align(scene.ego, scene.other)
        if alignment.accepted:
            squared.append(mahalanobis(alignment, scene.ego_SE2_other))
    assert len(squared) > 100
    assert np.mean(squared) < 6.0


def test_the_covariance_is_honest_about_a_detectors_errors() -> None:
    squared = []
    for scene in junction_frames(2):
        alignment = align(scene.ego, scene.other)
        if error_at(alignment.ego_SE2_other, scene.ego_SE2_other, scene.other) < 5.0:
            squared.append(mahalanobis(alignment, scene.ego_SE2_other))
    assert len(squared) > 50
    assert np.mean(squared) < 6.0


def test_more_common_objects_lower_the_risk() -> None:
    def spread(common: int) -> float:
        found = [align(p.ego, p.other) for p in (pair_of_views(common, seed) for seed in range(20))]
        return float(np.mean([np.trace(a.covariance) for a in found]))

    assert spread(20) < spread(10) < spread(5) < math.inf


def test_evidence_grows_with_common_objects() -> None:
    evidence = []
    for common in (4, 8, 12):
        scene = pair_of_views(common, 5)
        alignment = align(scene.ego, scene.other)
        assert 0.0 < alignment.margin <= alignment.evidence
        evidence.append(alignment.evidence)
    assert evidence == sorted(evidence)


# Options

SWITCHES = ["one_to_one", "heading_flips", "sizes", "refit", "temporal", "tracks", "range_tolerance", "verdict"]


@pytest.mark.parametrize("option", SWITCHES)
def test_every_option_can_be_switched_off(option: str) -> None:
    for seed in range(8):
        scene = pair_of_views(10, seed, 2, 2)
        glue = BEVGlue(BEVGlueConfig.model_validate({option: False}))
        for _ in range(3):
            alignment = glue.align(with_ids(scene.ego), with_ids(scene.other, 40))
            assert error_at(alignment.ego_SE2_other, scene.ego_SE2_other, scene.other) < 1.5, seed


def test_all_options_can_be_switched_off_together() -> None:
    scene = pair_of_views(10, 1, 2, 2)
    alignment = align(scene.ego, scene.other, **dict.fromkeys(SWITCHES, False))
    assert error_at(alignment.ego_SE2_other, scene.ego_SE2_other, scene.other) < 1.5


@given(seed=st.integers(0, 10**6), n=st.integers(1, 40), reach=st.sampled_from([8.0, 20.0, 60.0]))
@settings(max_examples=60, deadline=None)
def test_one_to_one_never_matches_a_row_twice(seed: int, n: int, reach: float) -> None:
    """Also where boxes lie closer together than the tolerance."""
    rng = np.random.default_rng([seed, 10, 0])
    boxes = random_boxes(n, rng, reach, apart=0.2)
    alignment = align(detected(boxes, rng), detected(boxes, rng), verdict=False)
    assert alignment.accepted
    for column, size in ((0, n), (1, n)):
        rows = alignment.matches[:, column].tolist()
        assert len(set(rows)) == len(rows)
        assert 0 <= min(rows) <= max(rows) < size


def test_without_one_to_one_boxes_match_twice() -> None:
    """Other reports one car twice, 0.3 m apart."""
    ego = cars([(0, 0, 10), (15, 4, 80), (22, -9, -35), (-12, 18, 140)])
    other = Boxes.concatenate([ego, cars([(0.3, 0, 10)])])
    assert len(align(ego, other, one_to_one=False).matches) == 5
    assert len(align(ego, other, one_to_one=True).matches) == 4


def test_without_heading_flips_reversed_headings_reduce_evidence() -> None:
    scene = pair_of_views(8, 2)
    turned = np.arange(len(scene.ego)) % 4 == 0
    ego = scene.ego.replace(yaw=scene.ego.yaw + np.pi * turned)
    with_flips, without = align(ego, scene.other), align(ego, scene.other, heading_flips=False)
    assert set(np.flatnonzero(turned)) <= set(with_flips.matches[:, 0].tolist())
    assert not set(np.flatnonzero(turned)) & set(without.matches[:, 0].tolist())


@pytest.mark.parametrize(("common", "clutter"), [(1, 0), (1, 6), (2, 0), (2, 6), (5, 0)])
def test_without_verdict_any_agreement_gives_a_pose(common: int, clutter: int) -> None:
    for seed in range(20):
        scene = pair_of_views(common, seed, clutter, clutter)
        alignment = align(scene.ego, scene.other, verdict=False)
        assert alignment.ego_SE2_other is not None
        assert len(alignment.matches) > 0
        ego, other = scene.ego[alignment.matches[:, 0]], scene.other[alignment.matches[:, 1]]
        gap = alignment.ego_SE2_other.apply(other.center[:, :2]) - ego.center[:, :2]
        assert np.hypot(gap[:, 0], gap[:, 1]).max() < 5.0, "what is matched lies together"


def test_the_verdict_only_takes_poses_away() -> None:
    refused = 0
    for scene in junction_frames(3):
        judged, unjudged = align(scene.ego, scene.other), align(scene.ego, scene.other, verdict=False)
        assert (judged.evidence, judged.margin) == (unjudged.evidence, unjudged.margin)
        refused += not judged.accepted
        assert not judged.accepted or content(judged) == content(unjudged)
    assert refused > 0


# Bad and extreme input


@pytest.mark.parametrize("bad", [None, [], np.zeros((3, 7)), {"boxes": []}], ids=["none", "list", "array", "dict"])
def test_non_boxes_input_raises_naming_the_side(bad: object) -> None:
    with pytest.raises(TypeError, match="ego must be Boxes"):
        BEVGlue().align(bad, Boxes.empty())  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="other must be Boxes"):
        BEVGlue().align(Boxes.empty(), bad)  # type: ignore[arg-type]


@pytest.mark.parametrize(("common", "clutter"), [(500, 0), (250, 250), (30, 470)])
def test_five_hundred_boxes_each(common: int, clutter: int) -> None:
    scene = pair_of_views(common, 1, clutter, clutter, reach=600.0)
    assert len(scene.ego) == len(scene.other) == 500
    alignment = align(scene.ego, scene.other, verdict=False)
    assert alignment.ego_SE2_other is not None
    assert np.isfinite(alignment.covariance).all()
    if common >= 250:
        assert error_at(alignment.ego_SE2_other, scene.ego_SE2_other, scene.other) < 1.0


DEGENERATE: dict[str, Callable[[], Boxes]] = {
    "all boxes in one place": lambda: cars([(3, 3, 0)] * 6),
    "all boxes on a line": lambda: cars([(7.0 * i**1.5, 0, 0) for i in range(6)]),
    "two boxes a thousand kilometres apart": lambda: cars([(-5e5, 0, 0), (5e5, 0, 40)]),
    "tiny boxes": lambda: cars([(0, 0, 0), (9, 5, 60), (-8, 15, 130)], (1e-6, 1e-6, 0.0)),
    "huge boxes": lambda: cars([(0, 0, 0), (9, 5, 60), (-8, 15, 130)], (1e6, 1e6, 1.0)),
    "headings of many turns": lambda: cars([(0, 0, 3.6e6), (9, 5, -7.2e6), (-8, 15, 1e6)]),
}


@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_scenes_give_a_finite_answer(case: str) -> None:
    """Seen twice from the same place, they leave every matched box where it is."""
    boxes = DEGENERATE[case]()
    alignment = align(boxes, boxes, verdict=False)
    assert alignment.ego_SE2_other is not None
    assert np.isfinite(alignment.covariance).all()
    assert math.isfinite(alignment.evidence)
    gap = alignment.ego_SE2_other.apply(boxes.center[alignment.matches[:, 1]]) - boxes.center[alignment.matches[:, 0]]
    assert np.abs(gap).max() < 2.0


@given(seed=st.integers(0, 10**6), m=st.integers(0, 12), n=st.integers(0, 12))
@settings(max_examples=60, deadline=None)
def test_any_two_lists_give_a_sound_answer(seed: int, m: int, n: int) -> None:
    """Lists of any lengths: the answer is a pose with its covariance and matches, or a refusal with its reason."""
    rng = np.random.default_rng([seed, 11, 0])
    ego, other = random_boxes(m, rng, 20.0, apart=0.0), random_boxes(n, rng, 20.0, apart=0.0)
    for verdict in (True, False):
        alignment = align(ego, other, verdict=verdict)
        assert alignment.accepted == (alignment.reason == "")
        assert alignment.matches.shape == (len(alignment.matches), 2)
        assert alignment.accepted == (len(alignment.matches) > 0)
        assert math.isfinite(alignment.evidence)
        assert math.isfinite(alignment.margin)
        if min(m, n) == 0:
            assert not alignment.accepted
