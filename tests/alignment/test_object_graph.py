"""The object graph: what an edge says, and that it says the same wherever the agent stands."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue import SE2, Boxes
from cobevglue.alignment.object_graph import ObjectGraph
from cobevglue.se2 import wrap_angle

from .scenes import cars, random_boxes, with_ids


def test_edges_of_three_boxes_by_hand() -> None:
    # Box 1 is 10 m ahead of box 0, turned left; box 2 is 5 m to the left of box 0, turned back.
    edge = ObjectGraph.of(cars([(0, 0, 0), (10, 0, 90), (0, 5, 180)])).edge
    right = math.pi / 2
    assert edge.shape == (3, 3, 3)
    np.testing.assert_allclose(edge[0, 1], [10.0, 0.0, right], atol=1e-12)
    np.testing.assert_allclose(edge[0, 2, :2], [5.0, right], atol=1e-12)
    assert abs(edge[0, 2, 2]) == math.pi
    # From box 1, which looks along +y: box 0 lies to its left and is turned right by 90 degrees.
    np.testing.assert_allclose(edge[1, 0], [10.0, right, -right], atol=1e-12)
    # (-10, 5) seen by one who looks along +y is 5 m ahead and 10 m to the left.
    np.testing.assert_allclose(edge[1, 2], [math.sqrt(125.0), math.atan2(10.0, 5.0), right], atol=1e-12)
    # Box 2 looks along -x: box 0, at (0, -5) from it, is to its left.
    np.testing.assert_allclose(edge[2, 0, :2], [5.0, right], atol=1e-12)
    # Box 1, at (10, -5) from it, is behind it and to the left.
    np.testing.assert_allclose(edge[2, 1], [math.sqrt(125.0), math.pi - math.atan2(5.0, 10.0), -right], atol=1e-12)


def test_edge_points_from_first_to_second_box() -> None:
    """Walking rho along theta, in the heading frame of the first box, ends at the second box with heading psi."""
    boxes = random_boxes(8, np.random.default_rng([1, 0, 0]))
    edge = ObjectGraph.of(boxes).edge
    for m in range(8):
        agent_SE2_m = SE2(boxes.center[m, 0], boxes.center[m, 1], boxes.yaw[m])
        for n in range(8):
            rho, theta, psi = edge[m, n]
            reached = agent_SE2_m @ SE2(rho * math.cos(theta), rho * math.sin(theta), psi)
            distance, turn = reached.error_to(SE2(boxes.center[n, 0], boxes.center[n, 1], boxes.yaw[n]))
            assert distance < 1e-9
            assert turn < 1e-9


def test_the_diagonal_is_zero() -> None:
    edge = ObjectGraph.of(random_boxes(5, np.random.default_rng([2, 0, 0]))).edge
    assert (edge[np.arange(5), np.arange(5)] == 0.0).all()


@given(
    seed=st.integers(0, 10**6),
    n=st.integers(0, 9),
    x=st.floats(-1e3, 1e3),
    y=st.floats(-1e3, 1e3),
    yaw=st.floats(-10.0, 10.0),
)
@settings(max_examples=50, deadline=None)
def test_edges_do_not_depend_on_the_frame(seed: int, n: int, x: float, y: float, yaw: float) -> None:
    boxes = random_boxes(n, np.random.default_rng([seed, 0, 0]))
    here, there = ObjectGraph.of(boxes), ObjectGraph.of(boxes.transform(SE2(x, y, yaw)))
    np.testing.assert_allclose(there.edge[..., 0], here.edge[..., 0], atol=1e-8)
    assert np.abs(wrap_angle(there.edge[..., 1:] - here.edge[..., 1:])).max(initial=0.0) < 1e-8
    np.testing.assert_array_equal(there.node, here.node)


def test_nodes_keep_size_and_track_ids() -> None:
    boxes = Boxes([[1, 2, 3], [4, 5, 6]], [[4.0, 2.0, 1.5], [9.0, 2.5, 3.0]], [0.1, 0.2], track_id=[7, 3])
    graph = ObjectGraph.of(boxes)
    assert graph.node.tolist() == [[4.0, 2.0], [9.0, 2.5]]
    assert graph.position.tolist() == [[1.0, 2.0], [4.0, 5.0]]
    assert graph.track_id is not None
    assert graph.track_id.tolist() == [7, 3]
    assert ObjectGraph.of(boxes.replace(track_id=None)).track_id is None


def test_no_box_and_one_box_are_graphs_too() -> None:
    empty, single = ObjectGraph.of(Boxes.empty()), ObjectGraph.of(with_ids(cars([(3, 4, 50)])))
    assert len(empty) == 0
    assert empty.edge.shape == (0, 0, 3)
    assert empty.node.shape == (0, 2)
    assert len(single) == 1
    assert single.edge.tolist() == [[[0.0, 0.0, 0.0]]]


def test_coincident_boxes_have_zero_length_edges() -> None:
    edge = ObjectGraph.of(cars([(5, 5, 0), (5, 5, 30)])).edge
    assert np.isfinite(edge).all()
    assert edge[0, 1, 0] == 0.0
    np.testing.assert_allclose(edge[0, 1, 2], math.radians(30.0))
