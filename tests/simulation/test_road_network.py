"""Stored road networks: all load, no split shares one with another, and their geometry is right by hand."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from cobevglue.simulation.road_network import (
    NETWORK_KINDS,
    NETWORKS,
    NETWORKS_FOLDER,
    Junction,
    Lane,
    RoadNetwork,
)

ALL = [name for names in NETWORKS.values() for name in names]


def lane(points: list[tuple[float, float]], index: int = 0, internal: bool = False) -> Lane:
    return Lane(f"road_{index}", "road", index, np.array(points, dtype=float), 3.0, 13.9, internal)


def network(*lanes: Lane, junctions: tuple[Junction, ...] = ()) -> RoadNetwork:
    return RoadNetwork("junction_by_hand", lanes, junctions, ())


def test_no_network_is_in_two_splits() -> None:
    assert set(NETWORKS) == {"train", "validation", "test"}
    for a, b in itertools.combinations(NETWORKS.values(), 2):
        assert not set(a) & set(b)
    contents = [(NETWORKS_FOLDER / f"{name}.net.xml.gz").read_bytes() for name in ALL]
    assert len(set(contents)) == len(ALL), "nor under another name"


@pytest.mark.parametrize(("split", "at_least"), [("train", 4), ("validation", 1), ("test", 1)])
def test_splits_have_every_kind_except_latest_in_test(split: str, at_least: int) -> None:
    for kind in NETWORK_KINDS[:-1] if split == "test" else NETWORK_KINDS:
        assert sum(RoadNetwork.load(name).kind == kind for name in NETWORKS[split]) >= at_least


def test_folder_has_only_listed_small_networks() -> None:
    files = list(NETWORKS_FOLDER.glob("*.net.xml.gz"))
    assert {file.name for file in files} == {f"{name}.net.xml.gz" for name in ALL}
    assert sum(file.stat().st_size for file in files) < 1_000_000


@pytest.mark.parametrize("name", ALL)
def test_roads_reach_far_enough_and_lead_somewhere(name: str) -> None:
    roads = RoadNetwork.load(name)
    x_min, y_min, x_max, y_max = roads.bounds
    assert 280 < max(x_max - x_min, y_max - y_min) < 560
    assert np.hypot(x_min + x_max, y_min + y_max) < 280, "the origin is about in the middle"
    edges = {lane.edge for lane in roads.lanes if not lane.internal}
    assert len(roads.routes) >= 4
    assert {edge for route in roads.routes for edge in route} == edges, "every road is on a way through"
    assert all(3.0 <= lane.width <= 4.2 and 5 < lane.speed_limit < 40 for lane in roads.lanes)


@pytest.mark.parametrize("name", [name for name in ALL if name.startswith("junction")])
def test_junctions_have_signals(name: str) -> None:
    assert "traffic_light" in {junction.kind for junction in RoadNetwork.load(name).junctions}


@pytest.mark.parametrize("name", [name for name in ALL if name.startswith(("crossing", "junction"))])
def test_left_turn_lanes_face_each_other(name: str) -> None:
    """The middle is ahead of the leftmost lane or right of that; at a junction it is half a lane to its left."""
    roads = RoadNetwork.load(name)
    leftmost = {lane.edge: lane for lane in roads.lanes if lane.edge.startswith("in") and "." in lane.edge}
    assert len(leftmost) == 4
    for lane in leftmost.values():
        before, stop = lane.centerline[-2:]
        ahead = (stop - before) / np.hypot(*(stop - before))
        left = -ahead[0] * stop[1] + ahead[1] * stop[0]  # of the middle, from the lane
        if name.startswith("crossing"):
            assert -2.0 * lane.width < left < 0.1
        else:
            assert left > 1.0


@pytest.mark.parametrize("name", [name for name in ALL if name.startswith("town")])
def test_in_towns_streets_cross_and_some_at_signals(name: str) -> None:
    crossings = [junction.kind for junction in RoadNetwork.load(name).junctions]
    assert len(crossings) >= 4
    assert "traffic_light" in crossings


def test_unknown_network_error_names_nearest() -> None:
    with pytest.raises(ValueError, match=r"'roundabout_train0'; did you mean 'roundabout_train_0'\?"):
        RoadNetwork.load("roundabout_train0")


@pytest.mark.parametrize(
    ("point", "distance", "why"),
    [
        ((50.0, 0.0), 0.0, "on the middle of the lane"),
        ((50.0, 1.4), 0.0, "on the lane, which is 1.5 m wide on each side"),
        ((50.0, 4.0), 2.5, "beside it"),
        ((50.0, -4.0), 2.5, "beside it on the other side"),
        ((-3.0, -4.0), 3.5, "5 m from its beginning"),
        ((110.0, 9.0), 0.0, "in the junction"),
        ((110.0, 12.0), 2.0, "beside the junction"),
    ],
)
def test_distance_to_the_road(point: tuple[float, float], distance: float, why: str) -> None:
    square = np.array([(100.0, -10.0), (120.0, -10.0), (120.0, 10.0), (100.0, 10.0)])
    roads = network(lane([(0, 0), (60, 0), (100, 0)]), junctions=(Junction("c", "priority", square),))
    assert roads.distance_to_road([point, point]) == pytest.approx([distance] * 2), why


def test_distance_of_no_points() -> None:
    assert network(lane([(0, 0), (60, 0)])).distance_to_road(np.zeros((0, 2))).shape == (0,)


def test_the_roadside_is_right_of_the_rightmost_lane() -> None:
    roads = network(
        lane([(0, 0), (0, 40)]),
        lane([(-3, 0), (-3, 40)], index=1),
        lane([(0, 40), (0, 50)], internal=True),
    )
    side = roads.roadside(10.0, offset=0.5)
    # The road leads north, so that its right is east; the lane reaches 1.5 m that way.
    np.testing.assert_allclose(side.xy, [(2.0, 5.0), (2.0, 15.0), (2.0, 25.0), (2.0, 35.0)], atol=1e-12)
    np.testing.assert_allclose(side.yaw, math.pi / 2)
    assert side.edge.tolist() == ["road"] * 4


def test_stored_roadside_is_beside_roads() -> None:
    roads = RoadNetwork.load("residential_train_0")
    distance = roads.distance_to_road(roads.roadside(3.0, offset=1.0).xy)
    assert distance.max() < 1.05
    assert np.median(distance) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("spacing", [0.0, -1.0, math.nan])
def test_a_spacing_that_is_none(spacing: float) -> None:
    with pytest.raises(ValueError, match="spacing must be > 0"):
        network(lane([(0, 0), (60, 0)])).roadside(spacing)
