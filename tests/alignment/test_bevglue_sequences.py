"""BEVGlue over time: what it remembers, how it gets out of a wrong memory, and what time must not do."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
import pytest

from cobevglue import SE2, BEVGlue, BEVGlueConfig, Boxes
from cobevglue.alignment import Alignment

from .scenes import (
    Pair,
    cars,
    content,
    detected,
    drive,
    error_at,
    junction,
    mahalanobis,
    pair_of_views,
    pairs_of,
    random_boxes,
    random_pose,
)

pytestmark = pytest.mark.usefixtures("warm_kernels")

WRONG = 3.0
"""A pose that lets other's boxes land farther off than this on average is wrong [m]."""
SYNCHRONISED = BEVGlueConfig(offset_std=0.05)
"""For agents that drive past what stands still, which does not show how late a list is."""
SOON = 15
"""Frames within which a new pose should be found: 1.5 s."""


def run(frames: Sequence[Pair], glue: BEVGlue | None = None) -> list[Alignment]:
    glue = glue or BEVGlue()
    return [glue.align(frame.ego, frame.other) for frame in frames]


def errors(frames: Sequence[Pair], alignments: Sequence[Alignment]) -> list[float]:
    """How far off other's boxes land in each frame [m]; infinite where the pose was refused."""
    return [error_at(a.ego_SE2_other, f.ego_SE2_other, f.other) for f, a in zip(frames, alignments, strict=True)]


def wrong_poses(frames: Sequence[Pair], alignments: Sequence[Alignment]) -> int:
    return sum(WRONG < error < math.inf for error in errors(frames, alignments))


def assert_followed(frames: Sequence[Pair], alignments: Sequence[Alignment], within: float, case: object) -> None:
    """Most of these frames have a pose, and every pose lets other's boxes land within this distance [m]."""
    found = [error for error in errors(frames, alignments) if error < math.inf]
    assert len(found) >= 0.8 * len(frames), f"{case}: only {len(found)} of {len(frames)} frames have a pose"
    assert max(found) < within, f"{case}: {max(found):.1f} m off"


def junction_frames(seed: int, frames: int = 40) -> list[Pair]:
    return [
        Pair(
            frame.agents["car1"].boxes,
            frame.agents["car2"].boxes,
            frame.ego_SE2_other("car1", "car2"),
            frame.matches("car1", "car2"),
        )
        for frame in junction(seed)[:frames]
    ]


def crossing(seed: int, clutter: int = 0, frames: int = 20) -> list[Pair]:
    """Two standing agents watch two cars that drive different ways at 8 m/s, and other cars that only one sees."""
    rng = np.random.default_rng([seed, 2, 0])
    start = random_boxes(2 + 2 * clutter, rng, 30.0)
    velocity = 8.0 * np.column_stack([np.cos(start.yaw), np.sin(start.yaw), np.zeros(len(start))])
    ego_SE2_world, other_SE2_world = random_pose(rng, 30.0), random_pose(rng, 30.0)
    ego_sees, other_sees = np.arange(2 + clutter), np.r_[0:2, 2 + clutter : 2 + 2 * clutter]
    sequence = []
    for k in range(frames):
        now = start.replace(center=start.center + 0.1 * k * velocity)
        ego = detected(now[ego_sees].transform(ego_SE2_world), rng)
        other = detected(now[other_sees].transform(other_SE2_world), rng)
        truth = ego_SE2_world @ other_SE2_world.inverse()
        sequence.append(Pair(ego, other, truth, np.array([[0, 0], [1, 1]])))
    return sequence


# What time is good for


def test_two_moving_objects_suffice_after_some_frames() -> None:
    for seed in range(12):
        frames = crossing(seed)
        alignments = run(frames)
        assert not alignments[0].accepted, seed
        assert_followed(frames[5:], alignments[5:], within=2.0, case=seed)


def test_three_objects_in_clutter_suffice_within_1500_ms() -> None:
    late, wrong, accepted = 0, 0, 0
    for seed in range(30):
        frames = drive(common=3, seed=seed)
        alignments = run(frames)
        late += min(errors(frames, alignments)[:SOON]) > 1.0
        wrong += wrong_poses(frames, alignments)
        accepted += sum(alignment.accepted for alignment in alignments)
    assert late <= 6
    assert accepted > 0.4 * 30 * 30
    assert wrong <= 0.02 * accepted


def test_frames_refused_alone_are_accepted_in_sequence() -> None:
    alone = together = frames_in_all = 0
    for seed in range(8):
        frames = junction_frames(seed)
        frames_in_all += len(frames)
        together += sum(alignment.accepted for alignment in run(frames))
        alone += sum(BEVGlue().align(frame.ego, frame.other).accepted for frame in frames)
    assert alone < together
    assert together > 0.9 * frames_in_all


def test_a_junction_is_followed_without_wrong_poses() -> None:
    for seed in range(8):
        frames = junction_frames(seed)
        alignments = run(frames)
        assert wrong_poses(frames, alignments) <= 2, seed
        assert np.median(errors(frames, alignments)) < 1.0, seed
        assert_followed(frames[SOON:], alignments[SOON:], within=WRONG, case=seed)


def test_time_makes_the_pose_better() -> None:
    """Noise averages out: after two seconds the error is smaller than a single frame's."""
    alone, together = [], []
    for seed in range(20):
        frames = drive(common=5, seed=seed, only_each=2)
        together += errors(frames, run(frames))[20:]
        alone += [
            error_at(BEVGlue().align(f.ego, f.other).ego_SE2_other, f.ego_SE2_other, f.other) for f in frames[20:]
        ]
    assert np.median(together) < np.median(alone)


def test_the_covariance_is_honest_over_time() -> None:
    squared = []
    for seed in range(20):
        frames = drive(common=5, seed=seed)
        for frame, alignment in zip(frames, run(frames), strict=True):
            if error_at(alignment.ego_SE2_other, frame.ego_SE2_other, frame.other) < WRONG:
                squared.append(mahalanobis(alignment, frame.ego_SE2_other))
    assert len(squared) > 300
    assert np.mean(squared) < 6.0


@pytest.mark.parametrize("common", [0, 1])
def test_time_does_not_make_up_a_pose(common: int) -> None:
    """Two agents that share nothing, or one object. What stands still by chance alike stays alike, so a few err."""
    accepted, frames_in_all = 0, 0
    for seed in range(30):
        frames = drive(common, seed)
        accepted += sum(alignment.accepted for alignment in run(frames))
        frames_in_all += len(frames)
    assert accepted <= 0.06 * frames_in_all


def test_row_of_equal_cars_stays_ambiguous() -> None:
    """Each agent sees another part of a parked row, so the most matches are in the wrong place: hardly any pose."""
    wrong, frames_in_all = 0, 0
    for seed in range(6):
        for seen, hidden, gap in ((8, 2, 6.0), (6, 1, 2.6), (12, 2, 2.6), (10, 3, 12.0)):
            rng = np.random.default_rng([seed, 11, 0])
            world = cars([(gap * i, 0.0, 90.0) for i in range(seen + hidden)])
            other_pose, frames = SE2(10.0, -5.0, 1.0), []
            for k in range(25):
                ego_pose = SE2(0.5 * k, -8.0, 0.0)
                ego = detected(world[:seen].transform(ego_pose.inverse()), rng)[rng.random(seen) > 0.1]
                other = detected(world[hidden:].transform(other_pose.inverse()), rng)[rng.random(seen) > 0.1]
                frames.append(Pair(ego, other, ego_pose.inverse() @ other_pose, np.zeros((0, 2), np.int64)))
            wrong += sum(2.0 < error < math.inf for error in errors(frames, run(frames)))
            frames_in_all += len(frames)
    assert wrong <= 0.04 * frames_in_all


# What must not change the answer


def test_sequence_poses_are_equivariant_to_frame_motion() -> None:
    """As in a single frame the way to a pose may differ, and a filter keeps the difference for a while."""
    same_verdict, same_matches, gaps = [], [], []
    for seed in range(8):
        rng = np.random.default_rng([seed, 3, 0])
        a, b = random_pose(rng, 500.0), random_pose(rng, 500.0)
        frames = junction_frames(seed, 15)
        moved = [
            Pair(f.ego.transform(a), f.other.transform(b), a @ f.ego_SE2_other @ b.inverse(), f.matches) for f in frames
        ]
        for here, there, frame in zip(run(frames), run(moved), moved, strict=True):
            same_verdict.append(here.accepted == there.accepted)
            if here.ego_SE2_other is not None and there.ego_SE2_other is not None:
                gaps.append(error_at(there.ego_SE2_other, a @ here.ego_SE2_other @ b.inverse(), frame.other))
                same_matches.append(pairs_of(here) == pairs_of(there))
    assert np.mean(same_verdict) >= 0.97
    assert np.mean(same_matches) >= 0.97
    assert np.median(gaps) < 1e-3
    assert max(gaps) < 0.3


def test_sequence_is_equivariant_to_moving_one_list() -> None:
    for seed in range(8):
        rng = np.random.default_rng([seed, 10, 0])
        (x, y), b = rng.uniform(-500.0, 500.0, 2), random_pose(rng, 500.0)
        a, frames = SE2(x, y, 0.0), junction_frames(seed, 15)
        moved = [Pair(f.ego.transform(a), f.other.transform(b), f.ego_SE2_other, f.matches) for f in frames]
        for here, there, frame in zip(run(frames), run(moved), moved, strict=True):
            assert here.accepted == there.accepted
            assert pairs_of(here) == pairs_of(there)
            if here.ego_SE2_other is not None:
                assert error_at(there.ego_SE2_other, a @ here.ego_SE2_other @ b.inverse(), frame.other) < 1e-6


def test_row_order_does_not_matter_over_time() -> None:
    for seed in range(6):
        rng = np.random.default_rng([seed, 4, 0])
        frames = drive(4, seed, first_id=0)
        orders = [(rng.permutation(len(f.ego)), rng.permutation(len(f.other))) for f in frames]
        mixed = [
            Pair(f.ego[p], f.other[q], f.ego_SE2_other, f.matches) for f, (p, q) in zip(frames, orders, strict=True)
        ]
        for here, there, (p, q), frame in zip(run(frames), run(mixed), orders, frames, strict=True):
            assert here.accepted == there.accepted
            assert {(int(p[m]), int(q[n])) for m, n in there.matches} == pairs_of(here)
            if here.ego_SE2_other is not None:
                assert error_at(there.ego_SE2_other, here.ego_SE2_other, frame.other) < 1e-6


def test_swapped_roles_invert_the_sequence() -> None:
    same_verdict, frames_in_all, gaps, turns = 0, 0, [], []
    for seed in range(8):
        frames = junction_frames(seed)
        swapped = [Pair(f.other, f.ego, f.ego_SE2_other.inverse(), f.matches[:, ::-1]) for f in frames]
        for here, there, frame in zip(run(frames), run(swapped), frames, strict=True):
            frames_in_all += 1
            same_verdict += here.accepted == there.accepted
            if here.ego_SE2_other is not None and there.ego_SE2_other is not None:
                gaps.append(error_at(there.ego_SE2_other.inverse(), here.ego_SE2_other, frame.other))
                turns.append(there.ego_SE2_other.inverse().error_to(here.ego_SE2_other)[1])
    assert same_verdict >= 0.95 * frames_in_all
    assert np.percentile(gaps, 99) < 0.2
    assert np.percentile(turns, 99) < math.radians(0.5)


def test_the_same_input_gives_the_same_bytes() -> None:
    for seed in range(3):
        frames = drive(4, seed, first_id=0)
        first = [content(alignment) for alignment in run(frames)]
        assert [content(alignment) for alignment in run(frames)] == first


def test_aligners_do_not_influence_each_other() -> None:
    """One for each collaborator, fed by turns, and each as if alone."""
    sequences = [drive(4, seed) for seed in range(3)]
    glues = [BEVGlue() for _ in sequences]
    by_turns = [
        [content(glue.align(frame.ego, frame.other)) for glue, frame in zip(glues, step, strict=True)]
        for step in zip(*sequences, strict=True)
    ]
    for index, frames in enumerate(sequences):
        assert [step[index] for step in by_turns] == [content(alignment) for alignment in run(frames)]


@pytest.mark.parametrize("config", [BEVGlueConfig(), BEVGlueConfig.paper()], ids=["robust", "paper"])
def test_after_reset_it_is_as_new(config: BEVGlueConfig) -> None:
    before, after = drive(4, 0, first_id=0, frames=12), drive(3, 1, first_id=0, frames=12)
    glue = BEVGlue(config)
    run(before, glue)
    glue.reset()
    assert [content(a) for a in run(after, glue)] == [content(a) for a in run(after, BEVGlue(config))]


def test_results_handed_out_stay_as_they_were() -> None:
    glue = BEVGlue()
    frames = drive(5, 2)
    kept = run(frames[:10], glue)
    before = [content(alignment) for alignment in kept]
    run(frames[10:], glue)
    assert [content(alignment) for alignment in kept] == before


def test_without_temporal_every_frame_stands_alone() -> None:
    config = BEVGlueConfig(temporal=False)
    frames = drive(4, 3, first_id=0)
    alone = [content(BEVGlue(config).align(frame.ego, frame.other)) for frame in frames]
    assert [content(alignment) for alignment in run(frames, BEVGlue(config))] == alone
    assert [content(BEVGlue().align(frame.ego, frame.other)) for frame in frames] == alone, "as the first frame is"


# Track ids


def renumbered(boxes: Boxes, table: dict[int, int]) -> Boxes:
    assert boxes.track_id is not None
    return boxes.replace(track_id=[table[int(track)] for track in boxes.track_id])


def test_the_numbers_of_the_tracks_mean_nothing() -> None:
    for seed in range(5):
        frames = drive(4, seed, first_id=0)
        rng = np.random.default_rng([seed, 5, 0])
        ids = {int(i) for f in frames for boxes in (f.ego, f.other) for i in boxes.track_id}  # type: ignore[union-attr]
        ego_table = dict(zip(sorted(ids), rng.permutation(len(ids)).tolist(), strict=True))
        other_table = dict(zip(sorted(ids), (rng.permutation(len(ids)) - 2**62).tolist(), strict=True))
        renamed = [
            Pair(renumbered(f.ego, ego_table), renumbered(f.other, other_table), f.ego_SE2_other, f.matches)
            for f in frames
        ]
        for there, here in zip(run(renamed), run(frames), strict=True):  # sums over tracks differ in their last bits
            assert there.accepted == here.accepted
            np.testing.assert_array_equal(there.matches, here.matches)
            if there.ego_SE2_other is not None and here.ego_SE2_other is not None:
                assert there.ego_SE2_other.error_to(here.ego_SE2_other) == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("without", ["ego", "other", "both", "by turns"])
def test_track_ids_may_be_missing(without: str) -> None:
    for seed in range(5):
        frames = []
        for k, frame in enumerate(drive(5, seed, first_id=0)):
            ego_has = without == "other" or (without == "by turns" and k % 2 == 0)
            other_has = without == "ego" or (without == "by turns" and k % 3 == 0)
            frames.append(
                Pair(
                    frame.ego if ego_has else frame.ego.replace(track_id=None),
                    frame.other if other_has else frame.other.replace(track_id=None),
                    frame.ego_SE2_other,
                    frame.matches,
                )
            )
        alignments = run(frames, BEVGlue(SYNCHRONISED))
        assert wrong_poses(frames, alignments) == 0
        assert_followed(frames[SOON:], alignments[SOON:], within=1.0, case=seed)


def test_ids_in_one_list_only_are_ignored() -> None:
    frames = drive(4, 6, first_id=0)
    one = [Pair(f.ego, f.other.replace(track_id=None), f.ego_SE2_other, f.matches) for f in frames]
    none = [Pair(f.ego.replace(track_id=None), f.other, f.ego_SE2_other, f.matches) for f in one]
    assert [content(a) for a in run(one)] == [content(a) for a in run(none)]


def test_wrong_ids_do_not_mislead() -> None:
    """A tracker that gives every object another's id in every frame."""
    for seed in range(8):
        rng = np.random.default_rng([seed, 6, 0])
        frames = [
            Pair(
                f.ego.replace(track_id=rng.permutation(len(f.ego))),
                f.other.replace(track_id=rng.permutation(len(f.other))),
                f.ego_SE2_other,
                f.matches,
            )
            for f in drive(5, seed)
        ]
        alignments = run(frames, BEVGlue(SYNCHRONISED))
        assert wrong_poses(frames, alignments) <= 1, seed
        assert_followed(frames[SOON:], alignments[SOON:], within=1.0, case=seed)


# Recovery


Disturbance: TypeAlias = Callable[[int, int | None], tuple[list[Pair], int]]
"""From a seed and the first track id to the frames and the number of the first one after the disturbance."""


def after_a_cut(seed: int, first_id: int | None) -> tuple[list[Pair], int]:
    """The frames become those of another scene, and so do the tracks."""
    first = drive(6, seed, frames=15, first_id=first_id)
    return first + drive(6, seed + 1000, first_id=None if first_id is None else first_id + 10**4), 15


def after_a_jump(seed: int, first_id: int | None) -> tuple[list[Pair], int]:
    """Ego's frame jumps to another place, its tracks go on: a localisation that was reset."""
    frames = drive(6, seed, frames=45, first_id=first_id)
    jump = random_pose(np.random.default_rng([seed, 7, 0]))
    moved = [Pair(f.ego.transform(jump), f.other, jump @ f.ego_SE2_other, f.matches) for f in frames[15:]]
    return frames[:15] + moved, 15


def after_a_second_without(seed: int, first_id: int | None) -> tuple[list[Pair], int]:
    """For a second ego sees nothing that other sees, but other things."""
    frames = drive(6, seed, frames=55, first_id=first_id)
    rng = np.random.default_rng([seed, 8, 0])
    standing, ids = random_boxes(14, rng), None if first_id is None else np.arange(14) + 10**5
    lost = [
        Pair(detected(standing, rng).replace(track_id=ids), f.other, f.ego_SE2_other, f.matches[:0])
        for f in frames[15:25]
    ]
    return frames[:15] + lost + frames[25:], 25


def after_a_blind_second(seed: int, first_id: int | None) -> tuple[list[Pair], int]:
    """For a second ego sees nothing at all."""
    frames = drive(6, seed, frames=55, first_id=first_id)
    blind = [Pair(f.ego[[]], f.other, f.ego_SE2_other, f.matches[:0]) for f in frames[15:25]]
    return frames[:15] + blind + frames[25:], 25


@pytest.mark.parametrize("first_id", [None, 0], ids=["no ids", "ids"])
@pytest.mark.parametrize("disturbance", [after_a_cut, after_a_jump, after_a_second_without, after_a_blind_second])
def test_it_recovers(disturbance: Disturbance, first_id: int | None) -> None:
    for seed in range(15):
        frames, back = disturbance(seed, first_id)
        alignments = run(frames, BEVGlue(SYNCHRONISED))
        found = errors(frames, alignments)
        assert min(found[back : back + SOON]) < 1.0, f"seed {seed}: the new pose is found within 1.5 s"
        assert_followed(frames[back + SOON :], alignments[back + SOON :], within=WRONG, case=seed)
        assert wrong_poses(frames, alignments) <= 3, f"seed {seed}: few wrong poses in between"


def test_empty_frame_is_refused_naming_the_side() -> None:
    frames = drive(6, 0)
    glue = BEVGlue()
    run(frames[:10], glue)
    for ego, other in ((frames[10].ego[[]], frames[10].other), (frames[11].ego, frames[11].other[[]])):
        alignment = glue.align(ego, other)
        assert not alignment.accepted
        assert alignment.reason
    assert min(errors(frames[12:17], run(frames[12:17], glue))) < 1.0, "the pose is back within half a second"
    assert "ego sees no object" in BEVGlue().align(frames[0].ego[[]], frames[0].other).reason
    assert "other sees no object" in BEVGlue().align(frames[0].ego, frames[0].other[[]]).reason


# The clock


@pytest.mark.parametrize("config", [BEVGlueConfig(), BEVGlueConfig.paper()], ids=["robust", "paper"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 10.0, 9.9, -1.0])
def test_non_increasing_time_raises_and_changes_nothing(config: BEVGlueConfig, bad: float) -> None:
    frames = drive(5, 1, frames=3, first_id=0)
    glue, undisturbed = BEVGlue(config), BEVGlue(config)
    for aligner in (glue, undisturbed):
        aligner.align(frames[0].ego, frames[0].other, time=10.0)
    with pytest.raises(ValueError, match="time must be"):
        glue.align(frames[1].ego, frames[1].other, time=bad)
    assert content(glue.align(frames[2].ego, frames[2].other, time=10.2)) == content(
        undisturbed.align(frames[2].ego, frames[2].other, time=10.2)
    )


def test_first_time_is_free_and_reset_restarts_clock() -> None:
    scene = pair_of_views(6, 0)
    glue = BEVGlue()
    for start in (1.7e9, -50.0, 0.0):
        assert glue.align(scene.ego, scene.other, time=start).accepted
        glue.reset()


def test_without_times_frames_come_at_ten_hertz() -> None:
    frames = drive(4, 2, frames=12)
    timed = BEVGlue()
    by_time = [content(timed.align(f.ego, f.other, time=0.1 * k)) for k, f in enumerate(frames)]
    untimed = run(frames)
    assert [c[4] for c in by_time] == [a.reason for a in untimed]
    timed.align(frames[0].ego, frames[0].other)
    with pytest.raises(ValueError, match="later"):
        timed.align(frames[0].ego, frames[0].other, time=1.15)


def test_after_a_long_gap_everything_is_forgotten() -> None:
    config = BEVGlueConfig(max_gap=2.0)
    before, after = drive(5, 3, frames=8, first_id=0), drive(2, 4, frames=1, first_id=0)[0]
    for gap, forgets in ((2.5, True), (1.5, False)):
        glue = BEVGlue(config)
        for k, frame in enumerate(before):
            glue.align(frame.ego, frame.other, time=0.1 * k)
        late = glue.align(after.ego, after.other, time=0.7 + gap)
        assert (content(late) == content(BEVGlue(config).align(after.ego, after.other))) is forgets


def test_frames_may_come_at_any_rate() -> None:
    """Every third frame, or at uneven times."""
    for seed in range(6):
        frames = drive(6, seed, frames=40)
        for kept in (range(0, 40, 3), sorted({int(k**1.3) for k in range(17)})):
            glue = BEVGlue()
            alignments = [glue.align(frames[k].ego, frames[k].other, time=0.1 * k) for k in kept]
            assert_followed([frames[k] for k in kept][5:], alignments[5:], within=1.0, case=seed)


def test_two_frames_may_be_a_nanosecond_apart() -> None:
    scene = pair_of_views(8, 0)
    glue = BEVGlue()
    for time in (5.0, 5.000000001, 5.000000002):
        alignment = glue.align(scene.ego, scene.other, time=time)
        assert error_at(alignment.ego_SE2_other, scene.ego_SE2_other, scene.other) < 1.0
        assert np.linalg.eigvalsh(alignment.covariance).min() > 0.0


def test_rotating_collaborator_is_followed() -> None:
    """Other's frame turns by 30 degrees a second: boxes far from its origin sweep fast."""
    for seed in range(5):
        rng = np.random.default_rng([seed, 9, 0])
        world, frames = random_boxes(8, rng), []
        for k in range(30):
            other_pose = SE2(10.0, -20.0, math.radians(3.0) * k)
            other = detected(world.transform(other_pose.inverse()), rng)
            frames.append(Pair(detected(world, rng), other, other_pose, np.zeros((0, 2), np.int64)))
        assert_followed(frames, run(frames), within=1.0, case=seed)
