"""The road networks shipped with the package, and the geometry of their lanes, junctions and roadsides.

    network = RoadNetwork.load("junction_train_0")
    network.distance_to_road(points)      # 0 on the road
    network.roadside(spacing=6.0)         # points along the right edge of every road, for kerbs, poles, parked cars

The world frame is right-handed, in metres, x east, y north, with its origin at the centre of the network. The files are
SUMO networks written by `tools/build_networks.py`; reading them requires neither SUMO nor libsumo.
"""

from __future__ import annotations

import gzip
import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from xml.etree import ElementTree

import numpy as np

from cobevglue.datasets.frame import did_you_mean
from cobevglue.typing import ArrayLike, BoolArray, FloatArray, StrArray

__all__ = [
    "NETWORKS",
    "NETWORKS_FOLDER",
    "NETWORK_KINDS",
    "Junction",
    "Lane",
    "RoadNetwork",
    "Roadside",
    "network_file",
]

NETWORK_KINDS = ("junction", "t_junction", "roundabout", "highway", "residential", "town", "crossing")
"""Kinds of network: signalised junction, T-junction, roundabout, highway with ramps, residential area, street grid of
a town, and the crossing of two wide roads."""

_VARIANTS = {"train": 10, "validation": 1, "test": 2}
_NOT_TESTED = ("crossing",)
"""Kinds added after results on the test networks were published, which have to stay comparable."""

NETWORKS: MappingProxyType[str, tuple[str, ...]] = MappingProxyType(
    {
        split: tuple(
            f"{kind}_{split}_{index}"
            for kind in NETWORK_KINDS
            if split != "test" or kind not in _NOT_TESTED
            for index in range(count)
        )
        for split, count in _VARIANTS.items()
    }
)
"""Names of the stored networks by split; the splits are disjoint."""

NETWORKS_FOLDER = Path(__file__).parent / "networks"

_DEFAULT_LANE_WIDTH = 3.2  # SUMO's default [m]
_CELL = 16.0  # side of the squares whose points share the candidate segments of a distance query [m]


@dataclass(frozen=True, eq=False, slots=True)
class Lane:
    """One lane, in its driving direction.

    Attributes:
        id: SUMO's id.
        edge: id of its directed road.
        index: 0 is the rightmost lane of its edge.
        centerline: (N, 2) points [m].
        width: [m].
        speed_limit: [m/s].
        internal: whether it lies within a junction.
    """

    id: str
    edge: str
    index: int
    centerline: FloatArray
    width: float
    speed_limit: float
    internal: bool

    @property
    def length(self) -> float:
        """Length of the centre line [m]."""
        return float(np.hypot(*np.diff(self.centerline, axis=0).T).sum())


@dataclass(frozen=True, eq=False, slots=True)
class Junction:
    """A junction of roads.

    Attributes:
        id: SUMO's id.
        kind: SUMO's type: "traffic_light", "priority", "right_before_left", …
        polygon: (N, 2) outline [m].
    """

    id: str
    kind: str
    polygon: FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class Roadside:
    """K points along the right edges of roads.

    Attributes:
        xy: (K, 2) points [m].
        yaw: (K,) driving direction [rad]; the road is on its left.
        edge: (K,) id of the directed road.
    """

    xy: FloatArray
    yaw: FloatArray
    edge: StrArray


@dataclass(frozen=True, eq=False)
class RoadNetwork:
    """Geometry of a road network in the world frame.

    Attributes:
        name: as in `NETWORKS`.
        lanes: all lanes, including those within junctions.
        junctions: all junctions with an area.
        routes: edges of the shortest route from every entry of the network to every reachable exit.
    """

    name: str
    lanes: tuple[Lane, ...]
    junctions: tuple[Junction, ...]
    routes: tuple[tuple[str, ...], ...]

    @classmethod
    def load(cls, name: str) -> RoadNetwork:
        """Load a stored network by name.

        Raises:
            ValueError: unknown name; the message suggests the nearest one.
        """
        with gzip.open(network_file(name)) as file:
            root = ElementTree.parse(file).getroot()
        lanes = tuple(_lane(edge, lane) for edge in root.iter("edge") for lane in edge.iter("lane"))
        junctions = tuple(
            Junction(node.attrib["id"], node.attrib["type"], polygon)
            for node in root.iter("junction")
            if len(polygon := _points(node.get("shape", ""))) >= 3
            and node.attrib["type"] not in ("internal", "dead_end")
        )
        return cls(name, lanes, junctions, tuple(_routes(root)))

    @property
    def kind(self) -> str:
        """One of `NETWORK_KINDS`."""
        return next(kind for kind in NETWORK_KINDS if self.name.startswith(f"{kind}_"))

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max of all lanes' centre lines [m]."""
        points = np.concatenate([lane.centerline for lane in self.lanes])
        (x_min, y_min), (x_max, y_max) = points.min(axis=0), points.max(axis=0)
        return float(x_min), float(y_min), float(x_max), float(y_max)

    def distance_to_road(self, points: ArrayLike) -> FloatArray:
        """(M,) distance of points (M, 2) from the nearest road surface [m]; 0 on it."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        distance = np.empty(len(points))
        if not len(points):
            return distance
        segments = self._segments
        cells, member = np.unique(np.floor(points / _CELL), axis=0, return_inverse=True)
        from_centre = _distances((cells + 0.5) * _CELL, segments)
        # Points of a cell are at most half its diagonal from its centre: only these segments can be the nearest.
        eligible = from_centre <= from_centre.min(axis=1, keepdims=True) + math.sqrt(2.0) * _CELL
        order = np.argsort(member.ravel(), kind="stable")
        for rows, near in zip(np.split(order, np.cumsum(np.bincount(member.ravel()))[:-1]), eligible, strict=True):
            distance[rows] = _distances(points[rows], segments[near]).min(axis=1)
        for junction in self.junctions:
            low, high = junction.polygon.min(axis=0), junction.polygon.max(axis=0)
            about = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
            distance[about[_inside(points[about], junction.polygon)]] = 0.0
        return np.maximum(distance, 0.0)

    def roadside(self, spacing: float, offset: float = 0.0) -> Roadside:
        """Points along the right edge of every road, without junctions.

        Args:
            spacing: between neighbours along a road [m].
            offset: distance to the right of the road's edge [m]; negative on the road.

        Raises:
            ValueError: `spacing` is not positive.
        """
        if not spacing > 0:
            raise ValueError(f"spacing must be > 0, got {spacing}")
        xy, yaw, edge = [np.zeros((0, 2))], [np.zeros(0)], []
        for lane in self.lanes:
            if lane.internal or lane.index != 0:
                continue
            at, heading = _sample(lane.centerline, spacing)
            right = np.column_stack([np.sin(heading), -np.cos(heading)])
            xy.append(at + (lane.width / 2 + offset) * right)
            yaw.append(heading)
            edge += [lane.edge] * len(at)
        return Roadside(np.concatenate(xy), np.concatenate(yaw), np.array(edge, dtype=np.str_))

    @cached_property
    def _segments(self) -> FloatArray:
        """(S, 5) start, direction vector and half width of lane segments and of junction outlines (half width 0)."""
        lines = [(lane.centerline, lane.width / 2) for lane in self.lanes]
        lines += [(np.vstack([junction.polygon, junction.polygon[:1]]), 0.0) for junction in self.junctions]
        return np.concatenate(
            [np.column_stack([line[:-1], np.diff(line, axis=0), np.full(len(line) - 1, half)]) for line, half in lines]
        )


def network_file(name: str) -> Path:
    """Path of a stored network.

    Raises:
        ValueError: unknown name; the message suggests the nearest one.
    """
    names = [known for split in NETWORKS.values() for known in split]
    if name not in names:
        raise ValueError(f"no road network {did_you_mean(name, names)}")
    return NETWORKS_FOLDER / f"{name}.net.xml.gz"


def _lane(edge: ElementTree.Element, lane: ElementTree.Element) -> Lane:
    return Lane(
        id=lane.attrib["id"],
        edge=edge.attrib["id"],
        index=int(lane.attrib["index"]),
        centerline=_points(lane.attrib["shape"]),
        width=float(lane.get("width", _DEFAULT_LANE_WIDTH)),
        speed_limit=float(lane.attrib["speed"]),
        internal=edge.get("function") == "internal",
    )


def _routes(root: ElementTree.Element) -> Iterator[tuple[str, ...]]:
    """Routes with the fewest edges from every edge without predecessor to every reachable edge without successor."""
    following: dict[str, list[str]] = {
        edge.attrib["id"]: [] for edge in root.iter("edge") if edge.get("function") != "internal"
    }
    for link in root.iter("connection"):
        start, end = link.attrib["from"], link.attrib["to"]
        if start in following and end not in following[start]:
            following[start].append(end)
    for source in sorted(set(following).difference(*following.values())):
        reached: dict[str, tuple[str, ...]] = {source: (source,)}
        queue = deque([source])
        while queue:
            here = queue.popleft()
            for edge in following[here]:
                if edge not in reached:
                    reached[edge] = (*reached[here], edge)
                    queue.append(edge)
            if not following[here]:
                yield reached[here]


def _points(shape: str) -> FloatArray:
    return np.array([point.split(",")[:2] for point in shape.split()], dtype=np.float64).reshape(-1, 2)


def _sample(line: FloatArray, spacing: float) -> tuple[FloatArray, FloatArray]:
    """(K, 2) equidistant points along a line, the first half a spacing from its start, and (K,) headings [rad]."""
    step = np.diff(line, axis=0)
    length = np.r_[0.0, np.cumsum(np.hypot(*step.T))]
    at = np.arange(spacing / 2, length[-1], spacing)
    xy = np.column_stack([np.interp(at, length, line[:, axis]) for axis in (0, 1)])
    piece = np.clip(np.searchsorted(length, at, side="right") - 1, 0, len(step) - 1)
    return xy, np.arctan2(step[piece, 1], step[piece, 0])


def _distances(points: FloatArray, segments: FloatArray) -> FloatArray:
    """(M, S) signed distances [m] of points (M, 2) from segments (S, 5) with a width; negative inside."""
    step_x, step_y = segments[:, 2], segments[:, 3]
    x, y = (points[:, None, axis] - segments[None, :, axis] for axis in (0, 1))
    share = np.clip((x * step_x + y * step_y) / np.maximum(step_x**2 + step_y**2, 1e-12), 0.0, 1.0)
    distance: FloatArray = np.hypot(x - share * step_x, y - share * step_y) - segments[:, 4]
    return distance


def _inside(points: FloatArray, polygon: FloatArray) -> BoolArray:
    """(M,) whether points (M, 2) are inside a polygon, by the even-odd rule."""
    inside = np.zeros(len(points), dtype=np.bool_)
    x, y = points.T
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < (bx - ax) * (y - ay) / (by - ay) + ax)
    return inside
