"""The paper's matcher: affinities and selection by hand, the whole against oracles that are written differently."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue import SE2, BEVGlue, BEVGlueConfig, Boxes
from cobevglue.alignment import AffinityConfig, Alignment
from cobevglue.alignment.common_subgraph import common_subgraph, edge_affinity, node_affinity, surviving_pairs
from cobevglue.alignment.object_graph import ObjectGraph
from cobevglue.typing import IntArray

from .scenes import cars, mahalanobis, pair_of_views, pairs_of, random_boxes, random_pose, with_ids

PLAIN = AffinityConfig(
    length_scale=2.0, width_scale=1.0, position_scale=2.0, heading_scale=0.5, node_threshold=0.3, edge_threshold=0.3
)
"""Round numbers, so that the cases below can be checked by hand whatever the defaults are."""

Pairs = set[tuple[int, int]]


def subgraph(
    ego: Boxes, other: Boxes, seeds: IntArray | None = None, config: AffinityConfig = PLAIN
) -> tuple[Pairs, float]:
    rows, confidence = common_subgraph(ObjectGraph.of(ego), ObjectGraph.of(other), seeds, config)
    pairs = {(int(m), int(n)) for m, n in rows}
    assert len(pairs) == len(rows), "no pair twice"
    return pairs, confidence


# Affinities


def test_node_affinities_by_hand() -> None:
    """Lengths 4, 6 and widths 2, 3 against a 4 x 2 box: equal, 2 m longer, 1 m wider."""
    ego = Boxes([[0, 0, 0], [9, 0, 0], [0, 9, 0]], [[4, 2, 1], [6, 2, 1], [4, 3, 1]], [0, 0, 0])
    other = Boxes([[50, 50, 0]], [[4, 2, 1]], [1.0])
    affinity = node_affinity(ObjectGraph.of(ego), ObjectGraph.of(other), PLAIN)
    np.testing.assert_allclose(affinity, [[1.0], [math.exp(-1.0)], [math.exp(-1.0)]])


@pytest.mark.parametrize(
    ("ego", "other", "affinity"),
    [
        pytest.param((10.0, 0.5, 1.0), (10.0, 0.5, 1.0), 1.0, id="equal edges"),
        pytest.param((10.0, 0.0, 0.0), (12.0, 0.0, 0.0), math.exp(-1.0), id="2 m longer"),
        pytest.param((0.0, 0.0, 0.0), (2.0, 2.2, 0.0), math.exp(-1.0), id="from the same place to 2 m away"),
        pytest.param(
            (3.0, 0.0, 0.0), (4.0, math.pi / 2, 0.0), math.exp(-6.25), id="3 m ahead and 4 m left are 5 m apart"
        ),
        pytest.param((5.0, 0.0, 0.0), (5.0, 0.0, 0.5), math.exp(-1.0), id="heading 0.5 rad off"),
        pytest.param((5.0, 3.1, 0.0), (5.0, 3.1 - 2 * math.pi, 0.0), 1.0, id="bearings count modulo a turn"),
        pytest.param((5.0, 0.0, 3.0), (5.0, 0.0, 3.0 - 2 * math.pi), 1.0, id="headings count modulo a turn"),
        pytest.param((5.0, 0.0, 3.0), (5.0, 0.0, 3.5 - 2 * math.pi), math.exp(-1.0), id="0.5 rad across the half turn"),
    ],
)
def test_edge_affinities_by_hand(ego: Sequence[float], other: Sequence[float], affinity: float) -> None:
    assert edge_affinity(np.array(ego), np.array(other), PLAIN) == pytest.approx(affinity)
    assert edge_affinity(np.array(other), np.array(ego), PLAIN) == pytest.approx(affinity), "it is symmetric"


# Expansion and selection, by hand

L_SHAPE = [(0, 0, 0), (20, 0, 0), (20, 15, 90)]


def test_expansion_takes_exactly_the_consistent_pairs() -> None:
    ego = cars([*L_SHAPE, (-30, 10, 45)])
    other = cars([*L_SHAPE, (-30, -10, 45)]).transform(SE2(7.0, 100.0, 2.0))
    pairs, confidence = subgraph(ego, other)
    assert pairs == {(0, 0), (1, 1), (2, 2)}
    assert confidence == pytest.approx(3 + 9), "Eq. 5 of three exact pairs: 3 nodes, 9 ordered pairs of nodes"


def test_more_nodes_win_against_a_higher_confidence() -> None:
    """Other has an exact copy of two of ego's cars, and a vague copy of all three: 2 m longer cars, 2 m displaced."""
    ego = cars(L_SHAPE)
    exact = cars([(0, 300, 0), (20, 300, 0)])
    vague = cars([(200, 0, 0), (222, 0, 0), (218, 15, 90)], (6.5, 1.9, 1.6))
    off = math.exp(-1.0)  # what 2 m take from an affinity; the two displaced ones are 4 m off each other
    for other, expected in ((exact, {(0, 0), (1, 1)}), (vague, {(0, 0), (1, 1), (2, 2)})):
        pairs, confidence = subgraph(ego, other)
        assert pairs == expected
        assert confidence == pytest.approx(6.0 if other is exact else 3 * off + 3 + 4 * off + 2 * off**4)
    assert subgraph(ego, Boxes.concatenate([exact, vague]))[0] == {(0, 2), (1, 3), (2, 4)}
    assert subgraph(ego, Boxes.concatenate([vague, exact]))[0] == {(0, 0), (1, 1), (2, 2)}


def test_seed_boxes_match_each_other_only() -> None:
    """A second detection of the seed's car, half a metre beside it, in either list."""
    twice = cars([*L_SHAPE, (0.5, 0, 0)])
    assert subgraph(cars(L_SHAPE), twice, np.array([[0, 0]]))[0] == {(0, 0), (1, 1), (2, 2)}
    assert subgraph(twice, cars(L_SHAPE), np.array([[0, 0]]))[0] == {(0, 0), (1, 1), (2, 2)}


def test_of_equally_many_nodes_the_confidence_decides() -> None:
    """Both copies have two cars; one is exact (2 nodes, 4 edges), one is 0.5 m longer. Their order does not matter."""
    ego = cars([(0, 0, 0), (10, 0, 0)])
    longer, exact = [(100.0, 0.0, 0.0), (110.5, 0.0, 0.0)], [(0.0, 100.0, 0.0), (10.0, 100.0, 0.0)]
    for other, expected, confidence in (
        (longer + exact, {(0, 2), (1, 3)}, 6.0),
        (exact + longer, {(0, 0), (1, 1)}, 6.0),
        (longer, {(0, 0), (1, 1)}, 2 + 2 + 2 * math.exp(-((0.5 / 2.0) ** 2))),
    ):
        pairs, found = subgraph(ego, cars(other))
        assert pairs == expected
        assert found == pytest.approx(confidence)


def test_node_affinities_decide_too() -> None:
    """Two copies at equal distances; the cars of one are as long as ego's."""
    ego = cars([(0, 0, 0), (10, 0, 0)])
    other = Boxes.concatenate(
        [cars([(50, 0, 0), (60, 0, 0)], (5.5, 1.9, 1.6)), cars([(0, 50, 0), (10, 50, 0)], (4.5, 1.9, 1.6))]
    )
    assert subgraph(ego, other)[0] == {(0, 2), (1, 3)}


def test_boxes_of_different_footprint_are_never_matched() -> None:
    ego, other = cars(L_SHAPE), cars(L_SHAPE, (12.0, 2.5, 3.0))
    assert subgraph(ego, other) == (set(), 0.0)


def test_a_threshold_is_exceeded_not_reached() -> None:
    """Edges of equal cars 2 m off in length have an affinity of exp(-1)."""
    ego, other = cars([(0, 0, 0), (10, 0, 0)]), cars([(0, 0, 0), (12, 0, 0)])
    affinity = float(edge_affinity(np.array([10.0, 0.0, 0.0]), np.array([12.0, 0.0, 0.0]), PLAIN))
    reached = PLAIN.model_copy(update={"edge_threshold": affinity})
    below = PLAIN.model_copy(update={"edge_threshold": math.nextafter(affinity, 0.0)})
    assert len(subgraph(ego, other, config=reached)[0]) == 1
    assert len(subgraph(ego, other, config=below)[0]) == 2


@pytest.mark.parametrize(("n_ego", "n_other"), [(0, 0), (0, 3), (3, 0), (1, 1), (1, 3)])
def test_subgraph_size_is_bounded_by_box_count(n_ego: int, n_other: int) -> None:
    pairs, _ = subgraph(cars(L_SHAPE[:n_ego]), cars(L_SHAPE[:n_other]))
    assert len(pairs) == min(n_ego, n_other)


def test_the_subgraph_grows_from_the_given_seeds_only() -> None:
    """Three cars agree, but the seed is another pair."""
    ego = cars([*L_SHAPE, (-60, -60, 30)])
    other = cars([*L_SHAPE, (80, 90, 30)])
    assert subgraph(ego, other)[0] == {(0, 0), (1, 1), (2, 2)}
    assert subgraph(ego, other, np.array([[3, 3]]))[0] == {(3, 3)}
    assert subgraph(ego, other, np.array([[3, 3], [1, 1]]))[0] == {(0, 0), (1, 1), (2, 2)}


# Time

FOUR = [(-80, 0, 0), (-80, 12, 30), (-95, 3, 60), (-70, 25, -40)]
APART = SE2(120.0, 40.0, 1.0)
"""Where the four stand in other's frame is not where the three put them: the two subgraphs exclude each other."""
THREE_EGO, FOUR_EGO = cars(L_SHAPE), cars(FOUR)
THREE_OTHER, FOUR_OTHER = cars(L_SHAPE).transform(SE2(-5.0, 8.0, -2.0)), cars(FOUR).transform(APART)
FIRST = (with_ids(THREE_EGO, 10), with_ids(THREE_OTHER, 50))


def both(ego_ids: Sequence[int], other_ids: Sequence[int]) -> tuple[Boxes, Boxes]:
    """The three and the four in both frames; these are the track ids of the three."""
    ego = Boxes.concatenate([THREE_EGO.replace(track_id=ego_ids), with_ids(FOUR_EGO, 100)])
    other = Boxes.concatenate([THREE_OTHER.replace(track_id=other_ids), with_ids(FOUR_OTHER, 200)])
    return ego, other


THREE, NEW_FOUR = {(0, 0), (1, 1), (2, 2)}, {(3, 3), (4, 4), (5, 5), (6, 6)}


@pytest.mark.parametrize(
    ("ego_ids", "other_ids", "expected"),
    [
        pytest.param([10, 11, 12], [50, 51, 52], THREE, id="all pairs are still tracked: only they seed"),
        pytest.param([10, 91, 92], [50, 51, 52], THREE, id="one surviving pair is enough"),
        pytest.param([91, 11, 92], [93, 51, 94], THREE, id="whichever it is"),
        pytest.param([91, 92, 93], [50, 51, 52], NEW_FOUR, id="none survived in ego: all pairs seed again"),
        pytest.param([10, 11, 12], [91, 92, 93], NEW_FOUR, id="none survived in other"),
        pytest.param([10, 91, 92], [93, 51, 52], NEW_FOUR, id="ids survived, but no pair of them"),
    ],
)
def test_later_frames_are_seeded_by_carried_tracks(
    ego_ids: Sequence[int], other_ids: Sequence[int], expected: Pairs
) -> None:
    glue = BEVGlue(BEVGlueConfig.paper())
    assert pairs_of(glue.align(*FIRST)) == THREE
    assert pairs_of(glue.align(*both(ego_ids, other_ids))) == expected


def test_only_the_last_frame_is_remembered() -> None:
    glue = BEVGlue(BEVGlueConfig.paper())
    glue.align(*FIRST)
    glue.align(with_ids(FOUR_EGO, 100), with_ids(FOUR_OTHER, 200))
    assert pairs_of(glue.align(*both([10, 11, 12], [50, 51, 52]))) == NEW_FOUR


@pytest.mark.parametrize("forget", ["reset", "gap", "no ids"])
def test_the_paper_starts_anew(forget: str) -> None:
    glue = BEVGlue(BEVGlueConfig.paper())
    glue.align(*FIRST, time=1.0)
    ego, other = both([10, 11, 12], [50, 51, 52])
    if forget == "reset":
        glue.reset()
    if forget == "no ids":
        other = other.replace(track_id=None)
    assert pairs_of(glue.align(ego, other, time=100.0 if forget == "gap" else 1.1)) == NEW_FOUR


def test_empty_frame_drops_carried_pairs() -> None:
    glue = BEVGlue(BEVGlueConfig.paper())
    glue.align(*FIRST)
    assert not glue.align(FIRST[0][[]], FIRST[1]).accepted
    assert pairs_of(glue.align(*both([10, 11, 12], [50, 51, 52]))) == NEW_FOUR


def test_surviving_pairs_are_matched_by_track_id() -> None:
    ego = ObjectGraph.of(cars(L_SHAPE).replace(track_id=[4, 2**62, -6]))
    other = ObjectGraph.of(cars(L_SHAPE[:2]).replace(track_id=[8, 9]))
    tracks = np.array([[2**62, 9], [4, 7], [5, 8], [-6, 8]])
    assert surviving_pairs(ego, other, tracks).tolist() == [[1, 1], [2, 0]]
    assert surviving_pairs(ego, ObjectGraph.of(cars(L_SHAPE)), tracks).shape == (0, 2)
    assert surviving_pairs(ego, other, tracks[:0]).shape == (0, 2)


# Against oracles


def stars_by_brute_force(ego: Boxes, other: Boxes, config: AffinityConfig) -> list[tuple[Pairs, float]]:
    """Every seed's subgraph and confidence, straight from the text: complex numbers and loops, no graph."""

    def edge(boxes: Boxes, a: int, b: int) -> tuple[complex, float]:
        step = complex(*(boxes.center[b, :2] - boxes.center[a, :2])) * cmath.exp(-1j * boxes.yaw[a])
        return step, float(boxes.yaw[b] - boxes.yaw[a])

    def node(m: int, n: int) -> float:
        dl, dw, _ = ego.size[m] - other.size[n]
        return math.exp(-((dl / config.length_scale) ** 2)) * math.exp(-((dw / config.width_scale) ** 2))

    def edges(p: int, m: int, q: int, n: int) -> float:
        (here, turn_here), (there, turn_there) = edge(ego, p, m), edge(other, q, n)
        turn = cmath.phase(cmath.exp(1j * (turn_here - turn_there)))
        gap = abs(here - there)
        return math.exp(-((gap / config.position_scale) ** 2) - (turn / config.heading_scale) ** 2)

    nodes = {(m, n): node(m, n) for m in range(len(ego)) for n in range(len(other))}
    similar = [pair for pair, affinity in nodes.items() if affinity > config.node_threshold]
    found = []
    for p, q in similar:
        star = {(p, q)}
        star |= {(m, n) for m, n in similar if m != p and n != q and edges(p, m, q, n) > config.edge_threshold}
        confidence = sum(nodes[pair] for pair in star)
        confidence += sum(edges(a, b, c, d) for a, c in star for b, d in star)
        found.append((star, confidence))
    return found


def largest_clique(adjacent: dict[tuple[int, int], Pairs], candidates: Pairs, size: int = 0, best: int = 0) -> int:
    """The exact number of nodes of the largest clique, by branch and bound."""
    if size + len({m for m, _ in candidates}) <= best:  # a row of ego joins a clique at most once
        return best
    if not candidates:
        return size
    pair = max(candidates, key=lambda each: len(adjacent[each] & candidates))
    best = largest_clique(adjacent, candidates & adjacent[pair], size + 1, best)
    return largest_clique(adjacent, candidates - {pair}, size, best)


def maximum_common_subgraph_size(ego: Boxes, other: Boxes, config: AffinityConfig) -> int:
    """How many pairs agree all with each other: both boxes differ, and the edges agree in both directions."""
    a, b = ObjectGraph.of(ego), ObjectGraph.of(other)
    rows = {(int(m), int(n)) for m, n in np.argwhere(node_affinity(a, b, config) > config.node_threshold)}

    def agree(x: tuple[int, int], y: tuple[int, int]) -> bool:
        (m, n), (p, q) = x, y
        there = edge_affinity(a.edge[m, p], b.edge[n, q], config) > config.edge_threshold
        back = edge_affinity(a.edge[p, m], b.edge[q, n], config) > config.edge_threshold
        return bool(m != p and n != q and there and back)

    return largest_clique({x: {y for y in rows if agree(x, y)} for x in rows}, rows)


@pytest.mark.parametrize("seed", range(12))
def test_the_subgraph_is_the_best_of_all_stars(seed: int) -> None:
    scene = pair_of_views(3 + seed % 4, seed, only_ego=3, only_other=2, reach=15.0 + 5.0 * (seed % 3))
    config = AffinityConfig()
    stars = stars_by_brute_force(scene.ego, scene.other, config)
    pairs, confidence = subgraph(scene.ego, scene.other, config=config)
    most = max(len(star) for star, _ in stars)
    assert len(pairs) == most
    assert confidence == pytest.approx(max(score for star, score in stars if len(star) == most))
    assert pairs in [star for star, score in stars if score == pytest.approx(confidence)]


@pytest.mark.parametrize("seed", range(12))
def test_star_equals_maximum_clique_on_consistent_scenes(seed: int) -> None:
    """Both see the same objects without errors: the seed's edges alone already say what all edges say."""
    scene = pair_of_views(3 + seed % 5, seed, noise=(0.0, 0.0, 0.0, 0.0))
    pairs, _ = subgraph(scene.ego, scene.other, config=AffinityConfig())
    assert len(pairs) == maximum_common_subgraph_size(scene.ego, scene.other, AffinityConfig()) == len(scene.ego)


@pytest.mark.parametrize("seed", range(12))
def test_star_is_at_least_the_maximum_clique(seed: int) -> None:
    """With clutter and errors a star may hold more than a clique, as its members are checked against the seed only."""
    scene = pair_of_views(3, seed, only_ego=3, only_other=3, reach=15.0)
    pairs, _ = subgraph(scene.ego, scene.other, config=AffinityConfig())
    assert len(pairs) >= maximum_common_subgraph_size(scene.ego, scene.other, AffinityConfig()) >= 1


# The pose


def align_once(ego: Boxes, other: Boxes) -> Alignment:
    return BEVGlue(BEVGlueConfig.paper()).align(ego, other)


@given(seed=st.integers(0, 10**6), n=st.integers(3, 8))
@settings(max_examples=40, deadline=None)
def test_noiseless_pose_is_exact_for_any_row_order(seed: int, n: int) -> None:
    rng = np.random.default_rng([seed, 0, 0])
    world = random_boxes(n, rng)
    ego_SE2_world, other_SE2_world = random_pose(rng), random_pose(rng)
    p, q = rng.permutation(n), rng.permutation(n)
    alignment = align_once(world[p].transform(ego_SE2_world), world[q].transform(other_SE2_world))
    assert alignment.ego_SE2_other is not None
    distance, turn = alignment.ego_SE2_other.error_to(ego_SE2_world @ other_SE2_world.inverse())
    assert distance < 1e-8
    assert turn < 1e-9
    assert pairs_of(alignment) == {(m, k) for m in range(n) for k in range(n) if p[m] == q[k]}


@given(seed=st.integers(0, 10**6))
@settings(max_examples=25, deadline=None)
def test_moving_the_frames_moves_the_papers_pose(seed: int) -> None:
    scene = pair_of_views(5, seed, only_ego=2, only_other=2)
    rng = np.random.default_rng([seed, 1, 0])
    a, b = random_pose(rng), random_pose(rng)
    here, there = align_once(scene.ego, scene.other), align_once(scene.ego.transform(a), scene.other.transform(b))
    assert here.ego_SE2_other is not None
    assert there.ego_SE2_other is not None
    distance, turn = there.ego_SE2_other.error_to(a @ here.ego_SE2_other @ b.inverse())
    assert distance < 1e-6
    assert turn < 1e-8
    assert pairs_of(here) == pairs_of(there)


@pytest.mark.parametrize(
    ("ego", "other"),
    [
        pytest.param(Boxes.empty(), Boxes.empty(), id="nobody sees anything"),
        pytest.param(cars(L_SHAPE), Boxes.empty(), id="other sees nothing"),
        pytest.param(Boxes.empty(), cars(L_SHAPE), id="ego sees nothing"),
        pytest.param(cars(L_SHAPE[:1]), cars(L_SHAPE), id="one object gives no rotation"),
        pytest.param(cars(L_SHAPE), cars(L_SHAPE, (12.0, 2.5, 3.0)), id="no two of the same size"),
    ],
)
def test_the_paper_refuses_without_two_pairs(ego: Boxes, other: Boxes) -> None:
    alignment = align_once(ego, other)
    assert not alignment.accepted
    assert "fewer than two" in alignment.reason


def test_the_papers_covariance_is_honest() -> None:
    """Eight matched pairs whose difference has the assumed spread: the error is a chi-square with three degrees."""
    config = BEVGlueConfig.paper()
    each = config.position_std / math.sqrt(2.0)
    rng = np.random.default_rng([9, 0, 0])
    squared = []
    for _ in range(300):
        world, truth = random_boxes(8, rng), random_pose(rng)
        blur = rng.normal(0.0, each, (2, 8, 2))
        ego = world.replace(center=world.center + np.column_stack([blur[0], np.zeros(8)]))
        other = world.replace(center=world.center + np.column_stack([blur[1], np.zeros(8)])).transform(truth.inverse())
        alignment = align_once(ego, other)
        if alignment.ego_SE2_other is None or pairs_of(alignment) != {(i, i) for i in range(8)}:
            continue
        squared.append(mahalanobis(alignment, truth))
    assert len(squared) > 200
    assert 2.3 < np.mean(squared) < 3.7
