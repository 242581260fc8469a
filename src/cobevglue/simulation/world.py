"""A simulated world: a road network with its surroundings, the traffic at one time, and LiDAR views of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets.poses import inverse_SE3, transform_boxes
from cobevglue.simulation.lidar import LidarSettings, RayScene, scan
from cobevglue.simulation.mesh import Mesh
from cobevglue.simulation.road_network import RoadNetwork
from cobevglue.simulation.scenery import Scenery, build_scenery
from cobevglue.simulation.traffic import TrafficSnapshot
from cobevglue.simulation.vehicle_shapes import vehicle_mesh
from cobevglue.typing import BoolArray, Float32Array, FloatArray, IntArray

__all__ = ["LidarView", "World", "WorldAtTime"]

_SCENERY_STREAM, _SHAPE_STREAM, _SCAN_STREAM = 20, 21, 22
_FIRST_PARKED_ID = 100_000
"""First id of parked vehicles; moving ones have smaller ids."""
_MARGIN = 7.0
"""Vehicles are included in the scene up to this distance beyond the range of a sensor [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class LidarView:
    """Point cloud of one sensor at one time, with the ground truth.

    Attributes:
        points: (N, 4) float32 x, y, z [m] and intensity in the LiDAR frame, including points on the agent's own body.
        own: (N,) whether a point is on the agent's own body.
        boxes: the K objects with at least one point, in the LiDAR frame, with ids and kinds.
        point_count: (K,) number of points on each object.
        world_SE3_lidar: (4, 4) pose of the sensor.
    """

    points: Float32Array
    own: BoolArray
    boxes: Boxes
    point_count: IntArray
    world_SE3_lidar: FloatArray


class World:
    """The static part of a world, determined by network and seed.

    Attributes:
        roads: the road network.
        seed: integer >= 0.
        scenery: ground, buildings, vegetation and parked vehicles.
        parked: the parked vehicles as boxes in the world frame, with ids from 100,000.

    Raises:
        ValueError: unknown network; the message suggests the nearest one.
        ModuleNotFoundError: embreex or trimesh is not installed.
    """

    def __init__(self, network: str, seed: int = 0) -> None:
        self.roads = RoadNetwork.load(network)
        self.seed = seed
        self.scenery: Scenery = build_scenery(self.roads, np.random.default_rng([seed, _SCENERY_STREAM, 0]))
        parked = self.scenery.parked
        self.parked = self._boxes_on_ground(
            np.array([(car.x, car.y) for car in parked]).reshape(-1, 2),
            np.array([car.size for car in parked]).reshape(-1, 3),
            np.array([car.yaw for car in parked]),
            _FIRST_PARKED_ID + np.arange(len(parked)),
            np.array([car.kind for car in parked], dtype=np.str_),
        )
        self._shapes: dict[int, Mesh] = {}
        self._scene = _ray_scene([(self.scenery.mesh, -1), *self._meshes(self.parked)])

    def at(self, traffic: TrafficSnapshot) -> WorldAtTime:
        """The world with this traffic on its roads."""
        xy = np.column_stack([traffic.x, traffic.y])
        size = np.column_stack([traffic.length, traffic.width, traffic.height])
        return WorldAtTime(self, self._boxes_on_ground(xy, size, traffic.yaw, traffic.id, traffic.kind))

    def _boxes_on_ground(
        self, xy: FloatArray, size: FloatArray, yaw: FloatArray, ids: IntArray, kinds: Sequence[str] | np.ndarray
    ) -> Boxes:
        """Boxes on the ground."""
        z = self.scenery.ground.height(xy) + size[:, 2] / 2
        return Boxes(center=np.column_stack([xy, z]), size=size, yaw=yaw, track_id=ids, label=kinds)

    def _meshes(self, vehicles: Boxes) -> list[tuple[Mesh, int]]:
        """The mesh of each vehicle in the world frame, with its id."""
        assert vehicles.track_id is not None
        assert vehicles.label is not None
        placed = []
        for row, vehicle in enumerate(vehicles.track_id.tolist()):
            if vehicle not in self._shapes:
                rng = np.random.default_rng([self.seed, _SHAPE_STREAM, vehicle])
                length, width, height = vehicles.size[row].tolist()
                self._shapes[vehicle] = vehicle_mesh(str(vehicles.label[row]), (length, width, height), rng)
            foot = vehicles.center[row] - [0.0, 0.0, vehicles.size[row, 2] / 2]
            placed.append((self._shapes[vehicle].moved(foot, float(vehicles.yaw[row])), vehicle))
        return placed


class WorldAtTime:
    """A world at one time.

    Attributes:
        world: the static world.
        moving: the traffic as boxes in the world frame.
        vehicles: all vehicles, moving and parked, in the world frame.
    """

    def __init__(self, world: World, moving: Boxes) -> None:
        self.world = world
        self.moving = moving
        self.vehicles = Boxes.concatenate([moving, world.parked])

    def sensor_on_vehicle(self, vehicle: int, settings: LidarSettings, rng: np.random.Generator) -> FloatArray:
        """(4, 4) pose of a sensor above the roof, 0.5 m behind the centre of a moving vehicle, as in OPV2V.

        It is tilted by the slope of the ground and by a few tenths of a degree at random.

        Raises:
            ValueError: no such vehicle.
        """
        assert self.moving.track_id is not None
        rows = np.flatnonzero(self.moving.track_id == vehicle)
        if not len(rows):
            raise ValueError(f"no moving vehicle {vehicle}")
        row = int(rows[0])
        yaw = float(self.moving.yaw[row])
        x, y = self.moving.center[row, :2] - 0.5 * np.array([np.cos(yaw), np.sin(yaw)])
        height = max(settings.height, float(self.moving.size[row, 2]) + 0.25)
        return self._sensor(x, y, yaw, height, rng.normal(scale=np.radians(0.3), size=2))

    def sensor_on_mast(self, x: float, y: float, yaw: float, settings: LidarSettings) -> FloatArray:
        """(4, 4) pose of a roadside unit's sensor."""
        return self._sensor(x, y, yaw, settings.height, np.zeros(2))

    def views(
        self,
        sensors: Sequence[tuple[FloatArray, int]],
        settings: Sequence[LidarSettings],
        index: int = 0,
    ) -> list[LidarView]:
        """Simulate several sensors at this time.

        Args:
            sensors: pose (4, 4) and vehicle id (-1 for a mast) of each sensor.
            settings: settings of each sensor.
            index: index of the frame, which seeds the noise.
        """
        if not sensors:
            return []
        places = np.array([pose[:2, 3] for pose, _ in sensors])
        reach = np.array([lidar.range + _MARGIN for lidar in settings])
        near = (np.hypot(*(self.moving.center[:, None, :2] - places[None]).transpose(2, 0, 1)) < reach).any(axis=1)
        scene = _ray_scene(self.world._meshes(self.moving[near]))
        return [
            self._view(scene, pose, carrier, lidar, np.random.default_rng([self.world.seed, _SCAN_STREAM + i, index]))
            for i, ((pose, carrier), lidar) in enumerate(zip(sensors, settings, strict=True))
        ]

    def _view(
        self, scene: RayScene, pose: FloatArray, carrier: int, settings: LidarSettings, rng: np.random.Generator
    ) -> LidarView:
        cloud = scan((self.world._scene, scene), pose, settings, rng)
        ids = self.vehicles.track_id
        assert ids is not None
        hit, count = np.unique(cloud.owner, return_counts=True)
        by_id = dict(zip(hit.tolist(), count.tolist(), strict=True))
        counts = np.array([by_id.get(vehicle, 0) for vehicle in ids.tolist()], dtype=np.int64)
        observed = (counts > 0) & (ids != carrier)
        boxes = transform_boxes(self.vehicles[observed], inverse_SE3(pose))
        own = (cloud.owner == carrier) & (carrier >= 0)
        return LidarView(cloud.points, own, boxes, counts[observed], pose)

    def _sensor(self, x: float, y: float, yaw: float, height: float, lean: FloatArray) -> FloatArray:
        ground = self.world.scenery.ground
        slope = ground.slope([[x, y]])[0]
        c, s = np.cos(yaw), np.sin(yaw)
        pitch = -np.arctan(slope @ [c, s]) + lean[0]
        roll = np.arctan(slope @ [-s, c]) + lean[1]
        about_z = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        about_y = np.array([[np.cos(pitch), 0.0, np.sin(pitch)], [0.0, 1.0, 0.0], [-np.sin(pitch), 0.0, np.cos(pitch)]])
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(roll), -np.sin(roll)], [0.0, np.sin(roll), np.cos(roll)]])
        pose = np.eye(4)
        pose[:3, :3] = about_z @ about_y @ about_x
        pose[:3, 3] = x, y, float(ground.height([[x, y]])[0]) + height
        return pose


def _ray_scene(meshes: Sequence[tuple[Mesh, int]]) -> RayScene:
    owner = [np.full(len(mesh), vehicle, dtype=np.int64) for mesh, vehicle in meshes]
    return RayScene(Mesh.concatenate([mesh for mesh, _ in meshes]), np.concatenate([np.zeros(0, np.int64), *owner]))
