"""BEVGlue for groups, on lists of boxes."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest

from cobevglue import SE2, BEVGlueConfig, Boxes
from cobevglue.alignment import Alignment, BEVGlueGroup, Observation, group_aligner
from cobevglue.alignment.bevglue import BEVGlue
from cobevglue.alignment.group import GroupAligner, Pairwise

from .observations import align
from .scenes import content, detected, drive, error_at, mahalanobis, random_boxes

pytestmark = pytest.mark.usefixtures("warm_kernels")

REACH = 45.0
"""Of the agents' detectors [m]."""


def views(world: Boxes, poses: list[SE2], seed: int, reach: float = REACH) -> dict[str, Observation]:
    """What agents at these poses detect within reach, with errors."""
    found = {}
    for k, pose in enumerate(poses):
        rng = np.random.default_rng([seed, 20, k])
        seen = world.transform(pose.inverse())
        seen = seen[np.hypot(seen.center[:, 0], seen.center[:, 1]) < reach]
        found[f"car{k}"] = Observation(boxes=detected(seen[rng.random(len(seen)) > 0.05], rng))
    return found


def outcomes(aligner: GroupAligner, observations: dict[str, Observation], poses: list[SE2], ego: int) -> Counter[str]:
    """How many of the other agents are right, wrong and refused."""
    found = aligner.align_group(f"car{ego}", observations)
    return Counter(verdict(found[f"car{k}"], observations, poses, ego, k) for k in range(len(poses)) if k != ego)


def verdict(alignment: Alignment, observations: dict[str, Observation], poses: list[SE2], ego: int, other: int) -> str:
    boxes = observations[f"car{other}"].boxes
    assert boxes is not None
    if not alignment.accepted:
        return "refused"
    return "right" if error_at(alignment.ego_SE2_other, poses[ego].inverse() @ poses[other], boxes) < 3.0 else "wrong"


def car_park(seed: int) -> tuple[Boxes, list[SE2]]:
    """Four rows of six parked cars, an eighth of the places empty, three cars that stand elsewhere; five agents."""
    rng = np.random.default_rng([seed, 21])
    places = np.array([(2.8 * column, 12.5 * row) for row in range(4) for column in range(6)])
    places = places[rng.random(len(places)) > 0.125]
    middle = places.mean(axis=0)
    center = np.vstack([places, middle + rng.uniform(-30.0, 30.0, (3, 2))])
    yaw = np.r_[np.full(len(places), 0.5 * math.pi), rng.uniform(-3.0, 3.0, 3)]
    n = len(center)
    size = np.column_stack([rng.uniform(4.2, 4.8, n), rng.uniform(1.75, 1.95, n), np.full(n, 1.6)])
    places_of_agents = middle + rng.uniform(-20.0, 20.0, (5, 2))
    poses = [SE2(x, y, rng.uniform(-3.0, 3.0)) for x, y in places_of_agents]
    return Boxes(np.column_stack([center, np.zeros(n)]), size, yaw), poses


@pytest.mark.parametrize(("seed", "refused_alone"), [(4, 8), (5, 10), (9, 0)])
def test_car_park_is_solved_by_the_group(seed: int, refused_alone: int) -> None:
    """One frame; all twenty pairs, each agent as ego."""
    world, poses = car_park(seed)
    observations = views(world, poses, seed)
    alone, group = Counter[str](), Counter[str]()
    for ego in range(5):
        alone += outcomes(Pairwise(BEVGlue), observations, poses, ego)
        group += outcomes(BEVGlueGroup(), observations, poses, ego)
    assert alone["refused"] >= refused_alone
    assert group == {"right": 20}


@pytest.mark.parametrize("seed", range(6))
def test_car_parks_are_never_wrong(seed: int) -> None:
    world, poses = car_park(seed)
    observations = views(world, poses, seed, reach=25.0)
    for ego in range(5):
        assert not outcomes(BEVGlueGroup(), observations, poses, ego)["wrong"]


def test_perfect_grid_larger_than_views_is_refused() -> None:
    places = np.array([(2.8 * column, 12.5 * row, 0.0) for row in range(8) for column in range(20)])
    world = Boxes(places, np.tile((4.5, 1.9, 1.6), (160, 1)), np.full(160, 0.5 * math.pi))
    poses = [SE2(20.0 + 5.6 * k, 40.0 + 3.0 * k, 0.3 * k) for k in range(5)]
    observations = views(world, poses, 0, reach=20.0)
    assert outcomes(BEVGlueGroup(), observations, poses, 0) == {"refused": 4}


def test_agent_without_overlap_comes_through_a_third() -> None:
    """Ego and agent 2 are 92 m apart and detect objects within 45 m; ten frames."""
    world = random_boxes(140, np.random.default_rng([3, 22]), reach=90.0)
    poses = [SE2(-45.0, 0.0, 0.2), SE2(0.0, 5.0, 2.0), SE2(47.0, -3.0, -1.0)]
    pairs, group = Pairwise(BEVGlue), BEVGlueGroup()
    for frame in range(10):
        observations = views(world, poses, frame)
        alone = pairs.align_group("car0", observations)["car2"]
        found = group.align_group("car0", observations)["car2"]
    assert not alone.accepted
    assert verdict(found, observations, poses, 0, 2) == "right"
    truth = poses[0].inverse() @ poses[2]
    assert found.ego_SE2_other is not None
    assert found.ego_SE2_other.error_to(truth)[1] < math.radians(2.0)
    assert mahalanobis(found, truth) < 11.3  # 99 % of chi-square with three degrees of freedom
    assert len(found.matches) == 0


@pytest.mark.parametrize("seed", range(5))
def test_unrelated_agent_stays_refused(seed: int) -> None:
    world = random_boxes(25, np.random.default_rng([seed, 23]), reach=40.0)
    elsewhere = random_boxes(25, np.random.default_rng([seed, 24]), reach=40.0)
    poses = [SE2(0.0, 0.0, 0.2), SE2(12.0, 5.0, 2.0), SE2(-9.0, 10.0, -1.0), SE2(3.0, -14.0, 0.7)]
    observations = views(world, poses, seed)
    observations["car3"] = views(elsewhere, poses, seed)["car3"]
    found = BEVGlueGroup().align_group("car0", observations)
    assert [found[f"car{k}"].accepted for k in (1, 2, 3)] == [True, True, False]


@pytest.mark.parametrize("share", [0.3, 0.5, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_shifted_boxes_do_not_move_other_agents(share: float, seed: int) -> None:
    """Agent 1 reports a share of its boxes 8 m off, those on its left."""
    world = random_boxes(35, np.random.default_rng([seed, 25]), reach=60.0)
    poses = [SE2(0.0, 0.0, 0.2), SE2(20.0, 5.0, 2.0), SE2(-15.0, 20.0, -1.0), SE2(33.0, -14.0, 0.7)]
    observations = views(world, poses, seed)
    boxes = observations["car1"].boxes
    assert boxes is not None
    left = boxes.center[:, 1] > np.quantile(boxes.center[:, 1], 1.0 - share)
    lie = boxes.replace(center=boxes.center + np.outer(left, (8.0, 0.0, 0.0)))
    observations["car1"] = Observation(boxes=lie)
    found = BEVGlueGroup().align_group("car0", observations)
    for k in (2, 3):
        assert verdict(found[f"car{k}"], observations, poses, 0, k) != "wrong"


def test_forged_scene_does_not_overrule_the_own_pair() -> None:
    """Agent 1 reports what the ego and agent 2 see, joined 12 m off."""
    world = random_boxes(30, np.random.default_rng([1, 26]), reach=45.0)
    poses = [SE2(0.0, 0.0, 0.2), SE2(4.0, 0.0, 0.0), SE2(15.0, 20.0, -1.0)]
    observations = views(world, poses, 1)
    assert outcomes(Pairwise(BEVGlue), observations, poses, 0)["right"] == 2
    own, others = observations["car0"].boxes, observations["car2"].boxes
    assert own is not None
    assert others is not None
    joined = others.transform(SE2(12.0, 0.0, 0.0) @ poses[0].inverse() @ poses[2])
    observations["car1"] = Observation(boxes=Boxes.concatenate([own, joined]))
    found = BEVGlueGroup().align_group("car0", observations)["car2"]
    assert verdict(found, observations, poses, 0, 2) != "wrong"


def test_two_agents_are_aligned_as_a_pair() -> None:
    sequence = drive(6, seed=0)
    group, pair = BEVGlueGroup(), Pairwise(BEVGlue)
    for frame in sequence:
        observations = {"ego": Observation(boxes=frame.ego), "other": Observation(boxes=frame.other)}
        expected = pair.align_group("ego", observations)["other"]
        assert content(group.align_group("ego", observations)["other"]) == content(expected)


def test_poses_of_certain_pairs_stay_as_they_are() -> None:
    world = random_boxes(25, np.random.default_rng([0, 23]), reach=40.0)
    poses = [SE2(0.0, 0.0, 0.2), SE2(12.0, 5.0, 2.0), SE2(-9.0, 10.0, -1.0)]
    observations = views(world, poses, 0)
    group = align(BEVGlueGroup(), observations)
    pairs = align(Pairwise(BEVGlue), observations)
    for name, alignment in group.items():
        assert alignment.accepted
        assert content(alignment) == content(pairs[name])


def test_agents_may_come_and_see_nothing() -> None:
    world = random_boxes(25, np.random.default_rng([0, 23]), reach=40.0)
    poses = [SE2(0.0, 0.0, 0.2), SE2(12.0, 5.0, 2.0), SE2(-9.0, 10.0, -1.0)]
    observations = views(world, poses, 0)
    group = BEVGlueGroup()
    assert group.align_group("car0", {"car0": observations["car0"]}) == {}
    blind = group.align_group("car0", observations | {"car2": Observation(boxes=Boxes.empty())})
    assert blind["car1"].accepted
    assert not blind["car2"].accepted
    assert blind["car2"].reason
    assert all(each.accepted for each in group.align_group("car0", observations).values())


def test_a_group_starts_anew_after_reset() -> None:
    world, poses = car_park(0)
    observations = views(world, poses, 0)
    group = BEVGlueGroup()
    first = group.align_group("car0", observations)
    group.reset()
    again = group.align_group("car0", observations)
    assert [content(first[name]) for name in first] == [content(again[name]) for name in first]


def test_group_of_the_registry() -> None:
    assert isinstance(group_aligner("bevglue-group"), BEVGlueGroup)


def test_settings_that_make_no_sense() -> None:
    with pytest.raises(ValueError, match=r"config\.method must be 'evidence'"):
        BEVGlueGroup(BEVGlueConfig.paper())


def test_hypotheses_are_sorted_and_positive_definite() -> None:
    world, poses = car_park(0)
    boxes = [observation.boxes for observation in views(world, poses, 0).values()]
    assert boxes[0] is not None
    assert boxes[1] is not None
    glue = BEVGlue()
    assert glue.hypotheses == ()
    alignment = glue.align(boxes[0], boxes[1])
    found = glue.hypotheses
    assert len(found) > 1
    assert [h.log_odds for h in found] == sorted((h.log_odds for h in found), reverse=True)
    assert all(np.linalg.eigvalsh(h.covariance).min() > 0.0 for h in found)
    assert alignment.accepted or alignment.reason
    paper = BEVGlue(BEVGlueConfig.paper())
    paper.align(boxes[0], boxes[1])
    assert paper.hypotheses == ()


def test_best_hypothesis_is_the_accepted_pose() -> None:
    frame = drive(8, seed=1)[0]
    glue = BEVGlue()
    alignment = glue.align(frame.ego, frame.other)
    assert alignment.ego_SE2_other is not None
    first = glue.hypotheses[0]
    assert first.ego_SE2_other.error_to(alignment.ego_SE2_other) == pytest.approx((0.0, 0.0), abs=1e-9)
    np.testing.assert_allclose(first.covariance, alignment.covariance, rtol=1e-6, atol=1e-9)
    assert first.log_odds > math.log(0.95 / 0.05)


def test_list_that_comes_again_is_no_new_one() -> None:
    """Of an agent whose message was lost, the last list is used again, with the time stamp that it has."""
    world, poses = car_park(1)
    group = BEVGlueGroup()
    for step in range(6):
        stamps = {"car0": 0.1 * step, "car1": 50.0 + 0.1 * (step // 2), "car2": 0.1 * step}
        observations = {
            name: Observation(seen.boxes, time=stamps[name]) for name, seen in views(world, poses[:3], step).items()
        }
        found = group.align_group("car0", observations, 0.1 * step)
    assert set(found) == {"car1", "car2"}
