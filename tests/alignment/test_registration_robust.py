"""The motion between points of which most pairs are wrong."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cobevglue.alignment.registration.robust import robust_motion, teaserpp_motion
from cobevglue.typing import FloatArray


def pairs(
    seed: int, right: int, wrong: int, noise: float = 0.1, dimensions: int = 3
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Target and source points, the right pairs first, and the rotation and translation between them."""
    rng = np.random.default_rng([seed, 0, 0])
    rotation = Rotation.random(rng=rng).as_matrix()
    if dimensions == 2:
        angle = rng.uniform(-math.pi, math.pi)
        rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    translation = rng.uniform(-50.0, 50.0, dimensions)
    source = rng.uniform(-30.0, 30.0, (right + wrong, dimensions))
    target = source @ rotation.T + translation + rng.uniform(-noise, noise, source.shape) / math.sqrt(dimensions)
    target[right:] = rng.uniform(-30.0, 30.0, (wrong, dimensions)) + translation
    return target, source, rotation, translation


def turn_between(a: FloatArray, b: FloatArray) -> float:
    """Degrees from one rotation to the other."""
    return math.degrees(math.acos(min(1.0, (np.trace(a @ b.T) - len(a) + 2.0) / 2.0)))


@given(seed=st.integers(0, 10**6), right=st.integers(12, 40), wrong=st.integers(0, 120), dimensions=st.integers(2, 3))
@settings(max_examples=25, deadline=None)
def test_the_right_pairs_win(seed: int, right: int, wrong: int, dimensions: int) -> None:
    target, source, rotation, translation = pairs(seed, right, wrong, dimensions=dimensions)
    motion = robust_motion(target, source, 0.3)
    assert turn_between(motion.rotation, rotation) < 1.0
    assert np.linalg.norm(motion.translation - translation) < 0.5
    assert set(range(right)) <= set(motion.inliers.tolist())
    assert len(motion.inliers) < right + 3 + wrong // 20


def test_nineteen_of_twenty_may_be_wrong() -> None:
    target, source, rotation, translation = pairs(3, 25, 475)
    motion = robust_motion(target, source, 0.2)
    assert turn_between(motion.rotation, rotation) < 0.5
    assert np.linalg.norm(motion.translation - translation) < 0.2


def test_exact_pairs_give_the_exact_motion() -> None:
    target, source, rotation, translation = pairs(4, 10, 30, noise=0.0)
    motion = robust_motion(target, source, 0.1)
    np.testing.assert_allclose(motion.rotation, rotation, atol=1e-10)
    np.testing.assert_allclose(motion.translation, translation, atol=1e-8)


def test_a_mirror_image_has_a_proper_rotation() -> None:
    _, source, _, _ = pairs(5, 20, 0)
    motion = robust_motion(source * (1.0, -1.0, 1.0), source, 0.3)
    assert np.linalg.det(motion.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_a_few_pairs_are_no_agreement(count: int) -> None:
    target, source, _, _ = pairs(6, count, 0)
    assert len(robust_motion(target, source, 0.3).inliers) <= 3


def test_points_in_one_place_are_no_agreement() -> None:
    """Equal differences of nothing agree with everything, and say nothing."""
    assert len(robust_motion(np.zeros((30, 3)), np.ones((30, 3)), 0.3).inliers) <= 3


def test_unrelated_points_hardly_agree() -> None:
    target, source, _, _ = pairs(7, 0, 200)
    assert len(robust_motion(target, source, 0.3).inliers) < 10


def test_own_solver_agrees_with_teaser() -> None:
    library = pytest.importorskip("teaserpp_python", reason="TEASER++ is not on PyPI: its own build is needed")
    target, source, rotation, translation = pairs(8, 30, 60)
    motion = teaserpp_motion(library, target, source, 0.3)
    assert turn_between(motion.rotation, rotation) < 1.0
    assert np.linalg.norm(motion.translation - translation) < 0.5
