"""How far a cloud is raised, by what is around the sensor."""

from __future__ import annotations

import numpy as np
import pytest

from cobevglue import SE2, CoBEVGlue
from cobevglue.datasets.frame import Frame
from cobevglue.datasets.labelled_cloud import count_points
from cobevglue.iou import bev_iou
from cobevglue.perception import Perception, PointPillars
from cobevglue.perception.ground_height import estimate_height_correction
from cobevglue.typing import Float32Array


def cloud(height: float, count: int = 2000, more: Float32Array | None = None) -> Float32Array:
    """Ground at -height all around, a third of the points on things up to 3 m high, and `more`."""
    rng = np.random.default_rng(0)
    z = np.where(np.arange(count) % 3 == 0, rng.uniform(0.0, 3.0, count), 0.0) - height
    points = np.column_stack([rng.uniform(-20, 20, (count, 2)), z, np.zeros(count)]).astype(np.float32)
    return points if more is None else np.concatenate([points, more])


@pytest.mark.parametrize(
    ("height", "wanted"),
    [
        (1.9, 0.0),  # on a car
        (1.6, 0.0),  # on a low one: training has seen as much
        (2.3, 0.0),  # on a van
        (5.0, 3.1),  # on a mast
        (2.9, 1.0),  # on a lorry
        (0.6, -1.3),  # on a robot
    ],
)
def test_the_ground_comes_to_where_it_is_expected(height: float, wanted: float) -> None:
    assert estimate_height_correction(cloud(height)) == pytest.approx(wanted, abs=0.02)


def test_own_vehicle_below_sensor_is_not_ground() -> None:
    roof = np.zeros((5000, 4), np.float32) + np.array([0.5, 0.0, -0.3, 0.0], np.float32)
    assert estimate_height_correction(cloud(1.9, more=roof)) == 0.0


@pytest.mark.parametrize("count", [0, 50])
def test_of_hardly_any_points_nothing_is_said(count: int) -> None:
    assert estimate_height_correction(cloud(5.0, count)) == 0.0


def test_points_without_a_height_do_not_count() -> None:
    holes = np.full((3000, 4), np.nan, np.float32)
    assert estimate_height_correction(cloud(5.0, more=holes)) == pytest.approx(3.1, abs=0.02)


@pytest.fixture(scope="module")
def mast() -> Frame:
    """A car, and a sensor on a mast beside the road."""
    pytest.importorskip("libsumo")
    from cobevglue.simulation.scenario import ScenarioSettings, simulated_scenario

    return simulated_scenario("validation", 0, 5, ScenarioSettings(frames=1, agents=1, roadside_units=1))[0]


def test_mast_sensor_boxes_are_in_its_frame(mast: Frame) -> None:
    agent, detector = mast.agents["-1"], PointPillars.pretrained("compact")
    assert agent.points is not None
    points = agent.points
    assert estimate_height_correction(points) > 2.0
    seen = agent.objects[count_points(points, agent.objects) >= 20]
    found = detector.detect(points)
    pairs = np.argwhere(bev_iou(seen, found) > 0.5)
    assert len(seen) > 5
    assert len(set(pairs[:, 0])) > 0.7 * len(seen)
    height = found.center[pairs[:, 1], 2] - seen.center[pairs[:, 0], 2]
    assert abs(np.median(height)) < 0.3  # in the LiDAR's frame again
    assert Perception(detector).step(points).height_correction == estimate_height_correction(points)


def test_a_car_and_a_mast_see_together(mast: Frame) -> None:
    system = CoBEVGlue.pretrained("compact", fusion="late", aligner="bevglue")
    clouds = {name: agent.points for name, agent in mast.agents.items() if agent.points is not None}
    for ego, other in (("car1", "-1"), ("-1", "car1")):
        system.reset()
        out = system.step(clouds, ego)
        found = out.alignments[other].ego_SE2_other
        poses = (mast.agents[name].world_SE3_lidar for name in (ego, other))
        true = SE2.from_matrix(np.linalg.inv(next(poses)) @ next(poses))
        assert found is not None
        assert found.error_to(true)[0] < 0.6
        near = out.boxes[np.abs(out.boxes.center[:, 0]) < 40.0]
        truth = mast.ground_truth(ego)
        row, column = np.argwhere(bev_iou(near, truth) > 0.5).T
        assert len(row) > 5
        assert np.abs(np.median(near.center[row, 2] - truth.center[column, 2])) < 0.4  # the ego's frame has its height
