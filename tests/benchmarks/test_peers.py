"""The matchers of other papers find what they should, and refuse where they have a threshold."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import pytest

from cobevglue import SE2, Boxes
from cobevglue.evaluation.alignment import AlignmentSequence, PairFrame
from peers import CBM, PEERS, VIPS, Clipper, FreeAlign, SingleFrameMatcher, V2XReg
from peers.clipper import densest_clique
from peers.search import SPACES, criterion, search

EGO_SE2_OTHER = SE2(12.0, -7.0, 2.1)
FIVE = ((23.0, -23.0, 0.1), (22.0, 31.0, 1.5), (-4.0, 32.0, -0.4), (-13.0, 12.0, 2.9), (-34.0, -30.0, -1.8))
"""x, y [m] and heading [rad] of five cars; their ten distances differ by more than 2 m."""
ELSEWHERE = ((0.0, 0.0, 0.8), (3.2, 6.0, 0.1), (-7.4, 1.0, 2.2), (5.5, -5.1, -1.2), (-2.0, 11.5, -2.9))
"""Five cars that share at most single distances with `FIVE`."""

every_peer = pytest.mark.parametrize("peer", PEERS.values(), ids=PEERS)


def cars(rows: tuple[tuple[float, float, float], ...], **fields: list[str]) -> Boxes:
    """Cars of slightly different sizes at x, y, heading."""
    x, y, yaw = np.array(rows).T
    size = [(4.2 + 0.15 * k, 1.8 + 0.03 * k, 1.5) for k in range(len(rows))]
    return Boxes(np.column_stack([x, y, np.zeros(len(x))]), size, yaw, **fields)


def strict(peer: type[SingleFrameMatcher]) -> SingleFrameMatcher:
    """The matcher with tight tolerances and at least four matches."""
    return {
        FreeAlign: FreeAlign(anchor_tolerance=0.6, box_tolerance=0.5, min_anchors=3),
        VIPS: VIPS(distance_rate=2.0, heading_rate=2.0, threshold=0.5, min_matches=4),
        V2XReg: V2XReg(min_affinity=3.0),
        CBM: CBM(position=1.0, min_matches=4),
        Clipper: Clipper(sigma=0.3, epsilon=0.8, min_matches=4),
    }[peer]


def test_the_ten_distances_differ() -> None:
    lengths = sorted(math.dist(a[:2], b[:2]) for a, b in itertools.combinations(FIVE, 2))
    assert np.diff(lengths).min() > 2.0


@every_peer
@pytest.mark.parametrize("published", [False, True])
def test_five_moved_cars_are_recovered(peer: type[SingleFrameMatcher], published: bool) -> None:
    matcher = peer.published() if published else peer()
    ego = cars(FIVE)
    order = [3, 0, 4, 2, 1]
    found = matcher.align(ego, ego.transform(EGO_SE2_OTHER.inverse())[order])
    assert found.ego_SE2_other is not None, found.reason
    translation, yaw = found.ego_SE2_other.error_to(EGO_SE2_OTHER)
    assert translation < 1e-3
    assert yaw < 1e-4
    assert {tuple(pair) for pair in found.matches.tolist()} <= {(row, order.index(row)) for row in range(5)}


@every_peer
def test_noise_and_unshared_cars_are_tolerated(peer: type[SingleFrameMatcher]) -> None:
    rng = np.random.default_rng(0)
    ego = cars((*FIVE, (40.0, 12.0, 0.0), (-30.0, -6.0, 1.0)))
    seen = cars((*FIVE, (-18.0, -33.0, 0.4)))
    other = seen.replace(center=seen.center + rng.normal(0.0, 0.05, (6, 3)), yaw=seen.yaw + rng.normal(0.0, 0.01, 6))
    found = peer().align(ego, other.transform(EGO_SE2_OTHER.inverse()))
    assert found.ego_SE2_other is not None, found.reason
    gap = found.ego_SE2_other.apply(other.transform(EGO_SE2_OTHER.inverse()).center) - other.center
    assert np.hypot(gap[:, 0], gap[:, 1]).max() < 0.5


@pytest.mark.parametrize("peer", [FreeAlign, V2XReg, CBM, Clipper])
def test_unrelated_cars_are_refused(peer: type[SingleFrameMatcher]) -> None:
    found = strict(peer).align(cars(FIVE), cars(ELSEWHERE))
    assert not found.accepted
    assert found.reason


@every_peer
@pytest.mark.parametrize("rows", [0, 1], ids=["no car", "one car"])
def test_too_few_cars_are_refused(peer: type[SingleFrameMatcher], rows: int) -> None:
    for ego, other in ((cars(FIVE), cars(FIVE)[:rows]), (cars(FIVE)[:rows], cars(FIVE))):
        assert "boxes" in peer().align(ego, other).reason


@every_peer
def test_the_same_frame_gives_the_same(peer: type[SingleFrameMatcher]) -> None:
    matcher, ego = peer(), cars(FIVE)
    first = matcher.align(ego, ego, 0.0)
    matcher.align(ego, cars(ELSEWHERE), 0.1)
    assert matcher.align(ego, ego, 0.2).ego_SE2_other == first.ego_SE2_other


@pytest.mark.parametrize("peer", [VIPS, V2XReg, CBM, Clipper])
def test_other_classes_are_never_matched(peer: type[SingleFrameMatcher]) -> None:
    ego, other = cars(FIVE, label=["car"] * 5), cars(FIVE, label=["bus"] * 5)
    assert not strict(peer).align(ego, other).accepted


@pytest.mark.parametrize(
    "matcher", [CBM(min_matches=4), V2XReg(min_affinity=3.0, half_turns=True)], ids=["CBM", "V2XReg"]
)
def test_headings_off_by_half_a_turn(matcher: SingleFrameMatcher) -> None:
    ego = cars(FIVE)
    other = ego.flip_headings([False, True, False, True, True]).transform(EGO_SE2_OTHER.inverse())
    found = matcher.align(ego, other)
    assert found.ego_SE2_other is not None, found.reason
    assert found.ego_SE2_other.error_to(EGO_SE2_OTHER) == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("peer", [FreeAlign, CBM, V2XReg])
def test_a_mirrored_scene_is_refused(peer: type[SingleFrameMatcher]) -> None:
    mirrored = cars(tuple((x, -y, -yaw) for x, y, yaw in FIVE))
    assert not strict(peer).align(cars(FIVE), mirrored).accepted


def test_clipper_takes_a_mirrored_scene_without_headings() -> None:
    """Distances alone do not tell left from right: the limit of the angle between headings does."""
    mirrored = cars(tuple((x, -y, -yaw) for x, y, yaw in FIVE))
    for heading, accepted in ((math.pi / 2, True), (0.1, False)):
        clipper = Clipper(sigma=0.3, epsilon=0.8, heading=heading, min_matches=4)
        assert clipper.align(cars(FIVE), mirrored).accepted is accepted


def test_densest_clique_prefers_the_heavier() -> None:
    """Two cliques of three, {0, 1, 2} with affinities of 0.9 and {3, 4, 5} with 0.5, joined by one edge."""
    affinity = np.eye(6)
    for nodes, weight in (((0, 1, 2), 0.9), ((3, 4, 5), 0.5), ((2, 3), 0.9)):
        for a, b in itertools.combinations(nodes, 2):
            affinity[a, b] = affinity[b, a] = weight
    u = densest_clique(affinity)
    assert np.flatnonzero(u > 1e-3).tolist() == [0, 1, 2]
    assert u @ affinity @ u == pytest.approx(1.0 + 2 * 0.9, abs=1e-3)


@pytest.mark.parametrize("seed", range(10))
def test_densest_clique_is_near_the_best(seed: int) -> None:
    """The best by exhaustion: u' M u over vectors on one clique is at most the largest eigenvalue there."""
    rng = np.random.default_rng(seed)
    upper = np.triu(rng.uniform(0.3, 1.0, (10, 10)) * (rng.uniform(size=(10, 10)) < 0.5), 1)
    affinity = upper + upper.T + np.eye(10)

    def is_clique(nodes: Sequence[int]) -> bool:
        return bool((affinity[np.ix_(nodes, nodes)] > 0.0).all())

    subsets = (nodes for k in range(1, 11) for nodes in itertools.combinations(range(10), k) if is_clique(nodes))
    best = max(np.linalg.eigvalsh(affinity[np.ix_(nodes, nodes)])[-1] for nodes in subsets)
    u = densest_clique(affinity)
    assert is_clique(np.flatnonzero(u > 1e-3).tolist())
    assert u @ affinity @ u >= 0.9 * best


@every_peer
def test_every_setting_is_searched(peer: type[SingleFrameMatcher]) -> None:
    settings = {name for name in vars(peer()) if not name.startswith("_")}
    assert settings == set(SPACES[peer.__name__])


def test_search_is_reproducible_and_scores_frames() -> None:
    """One frame that the published settings get right, and one of two unrelated lists, which they refuse."""
    ego = cars(FIVE)
    frames = [
        AlignmentSequence("moved", [PairFrame(ego, ego.transform(EGO_SE2_OTHER.inverse()), EGO_SE2_OTHER, 5)]),
        AlignmentSequence("unrelated", [PairFrame(ego, cars(ELSEWHERE), EGO_SE2_OTHER, 0)]),
    ]
    first, again = (search(FreeAlign, SPACES["FreeAlign"], frames, draws=3) for _ in range(2))
    assert [settings for settings, _ in first] == [settings for settings, _ in again]
    assert len(first) == 4
    published = first[0][1]
    assert (published.right, published.refused) == (0.5, 0.5)
    assert criterion(published) == pytest.approx(0.5)
