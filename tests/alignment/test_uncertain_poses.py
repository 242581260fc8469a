"""Composition of planar poses with covariances, against SE2 and against samples."""

from __future__ import annotations

import numpy as np
import pytest

from cobevglue import SE2
from cobevglue.alignment.uncertain_poses import compose, difference, invert, relative, to_se2, to_xyyaw
from cobevglue.typing import FloatArray

A, B = SE2(3.0, -2.0, 2.5), SE2(-7.0, 4.0, 1.9)
A_STD, B_STD = np.array([0.02, 0.01, 0.002]), np.array([0.01, 0.03, 0.003])
NOTHING = np.zeros((3, 3))


def sampled(pose: SE2, std: FloatArray, seed: int) -> list[SE2]:
    noise = np.random.default_rng(seed).normal(0.0, std, (4000, 3))
    return [SE2(*(to_xyyaw(pose) + each)) for each in noise]


def covariance_of(poses: list[SE2], center: FloatArray) -> FloatArray:
    errors = np.array([difference(to_xyyaw(pose), center) for pose in poses])
    covariance: FloatArray = np.cov(errors.T)
    return covariance


def test_pose_of_two_composed() -> None:
    pose, _ = compose(to_xyyaw(A), NOTHING, to_xyyaw(B), NOTHING)
    assert to_se2(pose).error_to(A @ B) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_covariance_of_two_composed() -> None:
    pose, covariance = compose(to_xyyaw(A), np.diag(A_STD**2), to_xyyaw(B), np.diag(B_STD**2))
    samples = [a @ b for a, b in zip(sampled(A, A_STD, 0), sampled(B, B_STD, 1), strict=True)]
    np.testing.assert_allclose(covariance, covariance_of(samples, pose), atol=0.08 * covariance.max())


def test_inverse_and_its_covariance() -> None:
    pose, covariance = invert(to_xyyaw(A), np.diag(A_STD**2))
    assert to_se2(pose).error_to(A.inverse()) == pytest.approx((0.0, 0.0), abs=1e-9)
    samples = [a.inverse() for a in sampled(A, A_STD, 0)]
    np.testing.assert_allclose(covariance, covariance_of(samples, pose), atol=0.08 * covariance.max())


def test_relative_pose_and_its_covariance() -> None:
    pose, covariance = relative(to_xyyaw(A), np.diag(A_STD**2), to_xyyaw(B), np.diag(B_STD**2))
    assert to_se2(pose).error_to(A.inverse() @ B) == pytest.approx((0.0, 0.0), abs=1e-9)
    samples = [a.inverse() @ b for a, b in zip(sampled(A, A_STD, 0), sampled(B, B_STD, 1), strict=True)]
    np.testing.assert_allclose(covariance, covariance_of(samples, pose), atol=0.08 * covariance.max())


def test_arrays_give_the_same_as_single_poses() -> None:
    many = np.array([to_xyyaw(A), to_xyyaw(B)])
    covariances = np.array([np.diag(A_STD**2), np.diag(B_STD**2)])
    poses, spread = compose(many, covariances, to_xyyaw(B), NOTHING)
    for i in range(2):
        pose, covariance = compose(many[i], covariances[i], to_xyyaw(B), NOTHING)
        np.testing.assert_allclose(poses[i], pose)
        np.testing.assert_allclose(spread[i], covariance)


def test_difference_of_yaws_is_wrapped() -> None:
    gap = difference(np.array([0.0, 0.0, 3.1]), np.array([0.0, 0.0, -3.1]))
    assert gap[2] == pytest.approx(6.2 - 2.0 * np.pi)
