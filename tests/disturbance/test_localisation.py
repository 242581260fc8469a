"""Claimed poses that are noisy, attacked, old or off."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cobevglue.datasets.poses import carla_from_SE3
from cobevglue.disturbance import LocalisationNoise, OffsetPose, ReplayedPose, SamePlace, Undisturbed, disturbance
from cobevglue.se2 import SE2

from .drives import KEY, drive

FRAMES = drive()


def test_noise_has_the_set_spread_in_plane_only() -> None:
    frames, noise = drive(600), LocalisationNoise(position=1.5, yaw=2.5)
    errors = []
    for index, now in enumerate(frames):
        claimed = noise.apply(frames, index, "ego", KEY).claimed
        errors += [carla_from_SE3(claimed[agent]) - carla_from_SE3(now.true[agent]) for agent in now.true]
    x, y, z, roll, yaw, pitch = np.array(errors).T
    yaw = (yaw + 180.0) % 360.0 - 180.0
    assert [x.std(), y.std(), yaw.std()] == pytest.approx([1.5, 1.5, 2.5], rel=0.07)
    assert np.abs([x.mean(), y.mean(), yaw.mean()]).max() < 0.2
    assert np.abs(np.corrcoef([x, y, yaw])[np.triu_indices(3, 1)]).max() < 0.1
    assert np.abs([z, roll, pitch]).max() < 1e-9


def test_noise_is_independent_per_frame_and_agent() -> None:
    noise = LocalisationNoise(position=1.0, yaw=1.0)
    shifts = [
        float(noise.apply(FRAMES, index, "ego", KEY).claimed[agent][0, 3] - FRAMES[index].true[agent][0, 3])
        for index in (0, 1)
        for agent in ("ego", "car2", "car3")
    ]
    assert len(set(shifts)) == 6
    assert all(shifts)


def test_noise_scales_with_level_for_same_key() -> None:
    def shift(level: float, key: tuple[int, ...] = KEY) -> float:
        heard = LocalisationNoise(position=level, yaw=level).apply(FRAMES, 4, "ego", key)
        return float(heard.claimed["car2"][1, 3] - FRAMES[4].true["car2"][1, 3])

    assert shift(2.5) == pytest.approx(5.0 * shift(0.5))
    assert shift(0.0) == 0.0
    assert shift(0.5) != shift(0.5, (8, 3)) != shift(0.5, (7, 4))


def test_noise_is_independent_of_other_agents() -> None:
    noise = LocalisationNoise()
    alone = noise.apply([frame.without("car2") for frame in FRAMES], 3, "ego", KEY)
    np.testing.assert_array_equal(alone.claimed["car3"], noise.apply(FRAMES, 3, "ego", KEY).claimed["car3"])


def test_attacked_agents_claim_the_ego_pose() -> None:
    heard = SamePlace().apply(FRAMES, 5, "ego", KEY)
    for claimed in heard.claimed.values():
        np.testing.assert_array_equal(claimed, FRAMES[5].true["ego"])


@pytest.mark.parametrize(
    ("index", "x"),
    [(0, 0.0), (4, 0.0), (10, 0.0), (15, 5.0)],
)
def test_replayed_pose_is_one_second_old(index: int, x: float) -> None:
    heard = ReplayedPose(seconds=1.0).apply(FRAMES, index, "ego", KEY)
    assert heard.claimed["car2"][0, 3] == x
    np.testing.assert_array_equal(heard.claimed["ego"], FRAMES[index].true["ego"])


def test_replayed_pose_of_late_agent_is_its_first() -> None:
    frames = [frame.without("car2") if i < 12 else frame for i, frame in enumerate(FRAMES)]
    assert ReplayedPose(seconds=1.0).apply(frames, 15, "ego", KEY).claimed["car2"][0, 3] == 12.0


def test_offset_is_constant_in_collaborator_frame() -> None:
    for index in (0, 9):
        heard = OffsetPose(x=3.0, y=-2.0, yaw=10.0).apply(FRAMES, index, "ego", KEY)
        true = FRAMES[index].true
        for agent in ("car2", "car3"):
            true_SE2_claimed = SE2.from_matrix(np.linalg.inv(true[agent]) @ heard.claimed[agent])
            assert true_SE2_claimed.error_to(SE2(3.0, -2.0, math.radians(10.0))) == pytest.approx((0, 0), abs=1e-9)
        np.testing.assert_array_equal(heard.claimed["ego"], true["ego"])


@pytest.mark.parametrize(
    "kind", [LocalisationNoise(), SamePlace(), ReplayedPose(), OffsetPose()], ids=lambda kind: type(kind).__name__
)
def test_only_claims_are_disturbed_and_they_stay_rigid(kind: LocalisationNoise) -> None:
    heard = kind.apply(FRAMES, 11, "ego", KEY)
    assert heard.observations is FRAMES[11].observations
    assert heard.true is FRAMES[11].true
    assert any((heard.claimed[agent] != FRAMES[11].claimed[agent]).any() for agent in heard.claimed)
    for claimed in heard.claimed.values():
        SE2.from_matrix(claimed)  # refuses what is no proper rigid transform
        assert claimed[2, 3] == pytest.approx(1.9, abs=0.1)  # the sensor leans


def test_undisturbed_is_as_it_was() -> None:
    assert Undisturbed().apply(FRAMES, 2, "ego", KEY) is FRAMES[2]


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("nosie", {}, "no disturbance 'nosie'; did you mean 'noise'"),
        ("noise", {"positon": 1.0}, "has no setting 'positon'; did you mean 'position'"),
        ("noise", {"position": -1.0}, "position"),
        ("noise", {"yaw": math.nan}, "yaw"),
        ("replay", {"seconds": 0.0}, "seconds"),
        ("loss", {"probability": 1.5}, "probability"),
        ("delay", {"seconds": 2.0}, "seconds"),
        ("fabricated", {"count": -1}, "count"),
    ],
)
def test_unknown_or_out_of_range_setting_is_named(name: str, options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        disturbance(name, **options)
