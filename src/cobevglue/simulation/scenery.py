"""Static surroundings of roads: uneven ground, kerbs, buildings, walls, poles, trees, furniture, parked vehicles.

The densities of buildings, vegetation and parked vehicles and the slope of the ground are random per world.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from cobevglue.simulation.mesh import Mesh, box, cylinder, ellipsoid, leaves, quads
from cobevglue.simulation.road_network import RoadNetwork
from cobevglue.typing import ArrayLike, FloatArray

__all__ = ["Ground", "ParkedVehicle", "Scenery", "build_scenery"]

_MARGIN = 70.0
"""Width of the ground beyond the roads [m]."""
_GROUND_CELL = 6.0
_KERB_STEP = 4.0

_CAR_KINDS = ("hatchback", "sedan", "suv", "coupe", "jeep", "pickup", "van")
_CAR_SHARES = (0.28, 0.27, 0.2, 0.08, 0.06, 0.05, 0.06)
_CAR_SIZES = {  # minimum and maximum of length, width over the mirrors, height [m]
    "hatchback": ((3.5, 1.75, 1.42), (4.3, 2.05, 1.65)),
    "sedan": ((4.4, 1.95, 1.38), (5.4, 2.2, 1.58)),
    "suv": ((4.2, 1.95, 1.55), (5.1, 2.25, 1.9)),
    "coupe": ((4.0, 1.85, 1.25), (4.9, 2.15, 1.42)),
    "jeep": ((3.7, 1.8, 1.7), (4.7, 2.1, 2.0)),
    "pickup": ((4.9, 2.0, 1.7), (5.9, 2.3, 2.0)),
    "van": ((4.7, 2.0, 1.85), (6.2, 2.35, 2.7)),
}


@dataclass(frozen=True, eq=False, slots=True)
class Ground:
    """Gently rolling ground: a sum of sine waves.

    Attributes:
        wave: (W, 2) wave vectors [rad/m].
        phase: (W,) phases [rad].
        amplitude: (W,) amplitudes [m].
    """

    wave: FloatArray
    phase: FloatArray
    amplitude: FloatArray

    @staticmethod
    def random(rng: np.random.Generator) -> Ground:
        """Random ground, from flat to slopes of a few per cent."""
        length, direction = rng.uniform(60.0, 250.0, size=4), rng.uniform(0.0, 2 * np.pi, size=4)
        wave = (2 * np.pi / length)[:, None] * np.column_stack([np.cos(direction), np.sin(direction)])
        steepness = rng.choice([0.0, 0.004, 0.012, 0.02])
        return Ground(wave, rng.uniform(0.0, 2 * np.pi, size=4), steepness * length / (2 * np.pi))

    def height(self, xy: ArrayLike) -> FloatArray:
        """(M,) height [m] at points (M, 2)."""
        angle = np.asarray(xy, dtype=np.float64).reshape(-1, 2) @ self.wave.T + self.phase
        return np.sin(angle) @ self.amplitude

    def slope(self, xy: ArrayLike) -> FloatArray:
        """(M, 2) gradient at points (M, 2)."""
        angle = np.asarray(xy, dtype=np.float64).reshape(-1, 2) @ self.wave.T + self.phase
        return (np.cos(angle) * self.amplitude) @ self.wave


@dataclass(frozen=True, slots=True)
class ParkedVehicle:
    """A parked vehicle: position [m], heading [rad], kind and size (length, width, height) [m]."""

    x: float
    y: float
    yaw: float
    kind: str
    size: tuple[float, float, float]


@dataclass(frozen=True, eq=False, slots=True)
class Scenery:
    """The static surroundings of roads.

    Attributes:
        ground: height of the ground.
        mesh: everything except vehicles, in the world frame.
        parked: vehicles beside the roads and on car parks.
    """

    ground: Ground
    mesh: Mesh
    parked: tuple[ParkedVehicle, ...]


def build_scenery(roads: RoadNetwork, rng: np.random.Generator) -> Scenery:
    """Random surroundings of a road network."""
    return _Builder(roads, rng).build()


@dataclass
class _Builder:
    roads: RoadNetwork
    rng: np.random.Generator
    parts: list[Mesh] = field(default_factory=list)
    parked: list[ParkedVehicle] = field(default_factory=list)
    occupied: list[tuple[float, float, float]] = field(default_factory=list)  # discs: x, y, radius

    def build(self) -> Scenery:
        rng = self.rng
        self.ground = Ground.random(rng)
        built_up, green, parking = rng.uniform(0.1, 1.0), rng.uniform(0.0, 1.0), rng.uniform(0.0, 0.7) ** 1.5
        if self.roads.kind == "highway":
            built_up *= 0.3
        if self.roads.kind == "residential":
            parking = max(parking, 0.25)
        wide = self.roads.kind in ("town", "crossing")
        no_parking = self.roads.kind == "highway" or (wide and rng.random() < 0.5)
        self._lay_ground()
        pavement = float(rng.uniform(1.2, 4.5))
        if self.roads.kind != "highway" or rng.random() < 0.3:
            self._lay_kerbs(float(rng.uniform(0.06, 0.22)), pavement)
        else:
            self._guard_rails()
        self._park_along(0.0 if no_parking else parking)
        self._buildings(built_up, pavement)
        self._car_parks(0 if no_parking else int(rng.integers(0, 4)))
        self._walls(built_up)
        self._street_furniture(pavement, built_up)
        self._trees(green, pavement)
        return Scenery(self.ground, Mesh.concatenate(self.parts), tuple(self.parked))

    # ---- free space

    def _free(self, x: float, y: float, radius: float) -> bool:
        if not self.occupied:
            return True
        discs = np.array(self.occupied)
        return bool((np.hypot(discs[:, 0] - x, discs[:, 1] - y) > discs[:, 2] + radius).all())

    def _off_road(self, corners: FloatArray, clearance: float) -> bool:
        return bool(self.roads.distance_to_road(corners).min() > clearance)

    def _z(self, x: float, y: float) -> float:
        return float(self.ground.height([[x, y]])[0])

    def _beside_roads(self, spacing: float, low: float, high: float) -> FloatArray:
        """(K, 3) x, y, yaw of places `low` to `high` [m] right of road edges, off all roads, in random order."""
        side = self.roads.roadside(spacing)
        if not len(side.xy):
            return np.zeros((0, 3))
        away = self.rng.uniform(low, high, size=len(side.yaw))
        along = self.rng.uniform(-spacing / 2, spacing / 2, size=len(side.yaw))
        forward = np.column_stack([np.cos(side.yaw), np.sin(side.yaw)])
        right = np.column_stack([np.sin(side.yaw), -np.cos(side.yaw)])
        xy = side.xy + away[:, None] * right + along[:, None] * forward
        clear = self.roads.distance_to_road(xy) > 0.9 * low
        places = np.column_stack([xy, side.yaw])[clear]
        return places[self.rng.permutation(len(places))]

    # ---- the ground

    def _lay_ground(self) -> None:
        x_min, y_min, x_max, y_max = self.roads.bounds
        x = np.arange(x_min - _MARGIN, x_max + _MARGIN, _GROUND_CELL)
        y = np.arange(y_min - _MARGIN, y_max + _MARGIN, _GROUND_CELL)
        grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        z = self.ground.height(grid.reshape(-1, 2)).reshape(grid.shape[:2])
        off_road = self.roads.distance_to_road(grid.reshape(-1, 2)).reshape(grid.shape[:2]) > 8.0
        z = z + np.where(off_road, self.rng.normal(scale=self.rng.uniform(0.0, 0.12), size=z.shape), 0.0)
        corner = np.concatenate([grid, z[..., None]], axis=-1)
        faces = np.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], axis=2)
        self.parts.append(quads(faces, 0.25))

    def _lay_kerbs(self, height: float, width: float) -> None:
        """Kerb stones and pavement slabs along the roads."""
        near = self.roads.roadside(_KERB_STEP, 0.05)
        far = self.roads.roadside(_KERB_STEP, width)
        if len(near.xy) < 2:
            return
        joined = near.edge[:-1] == near.edge[1:]
        joined &= (self.roads.distance_to_road(far.xy)[:-1] > 0.8 * width) & (
            self.roads.distance_to_road(far.xy)[1:] > 0.8 * width
        )
        low = np.column_stack([near.xy, self.ground.height(near.xy) - 0.02])
        top = low + [0.0, 0.0, height + 0.02]
        back = np.column_stack([far.xy, self.ground.height(far.xy) + height])
        stones = np.stack([low[:-1], low[1:], top[1:], top[:-1]], axis=1)[joined]
        slabs = np.stack([top[:-1], top[1:], back[1:], back[:-1]], axis=1)[joined]
        self.parts.append(quads(np.concatenate([stones, slabs]), 0.35))

    def _guard_rails(self) -> None:
        side = self.roads.roadside(_KERB_STEP, float(self.rng.uniform(0.6, 2.5)))
        joined = side.edge[:-1] == side.edge[1:]
        joined &= self.roads.distance_to_road(side.xy)[:-1] > 0.4
        base = np.column_stack([side.xy, self.ground.height(side.xy)])
        bottom, top = base + [0.0, 0.0, 0.45], base + [0.0, 0.0, 0.78]
        rails = np.stack([bottom[:-1], bottom[1:], top[1:], top[:-1]], axis=1)[joined]
        self.parts.append(quads(rails, 0.7))
        for x, y, z in base[:-1][joined]:
            self.parts.append(box((x, y, z + 0.35), (0.1, 0.1, 0.7), reflectivity=0.6))

    # ---- parked vehicles

    def _car(self, x: float, y: float, yaw: float) -> None:
        kind = str(self.rng.choice(_CAR_KINDS, p=_CAR_SHARES))
        low, high = _CAR_SIZES[kind]
        length, width, height = self.rng.uniform(low, high)
        self.parked.append(ParkedVehicle(x, y, yaw, kind, (float(length), float(width), float(height))))
        self.occupied.append((x, y, float(length) / 2))

    def _park_along(self, share: float) -> None:
        rng = self.rng
        side = self.roads.roadside(6.6, 1.15)
        clear = self.roads.distance_to_road(side.xy) > 1.0
        for (x, y), yaw in zip(side.xy[clear], side.yaw[clear], strict=True):
            if rng.random() < share and self._free(x, y, 2.9):
                turned = yaw + rng.normal(scale=0.02) + (np.pi if rng.random() < 0.12 else 0.0)
                shift = rng.uniform(-0.3, 0.3)
                self._car(float(x + shift * np.cos(yaw)), float(y + shift * np.sin(yaw)), float(turned))

    def _car_parks(self, count: int) -> None:
        rng = self.rng
        for x, y, yaw in self._beside_roads(15.0, 9.0, 25.0)[:count]:
            angle = yaw + rng.choice([0.0, 0.0, rng.uniform(-0.8, 0.8)])
            slant = rng.choice([np.pi / 2, np.pi / 2, np.pi / 3, 0.0])
            gap = 2.7 if slant else 6.4
            fill = rng.uniform(0.3, 0.9)
            for row in range(int(rng.integers(1, 3))):
                for slot in range(int(rng.integers(4, 10))):
                    along, across = (slot - 4) * gap + rng.normal(scale=0.1), row * 7.0 + rng.normal(scale=0.15)
                    px = float(x + along * np.cos(angle) - across * np.sin(angle))
                    py = float(y + along * np.sin(angle) + across * np.cos(angle))
                    if rng.random() < fill and self._off_road(np.array([[px, py]]), 3.5):
                        blocked = any(
                            radius > 3.5 and np.hypot(tx - px, ty - py) < radius + 2.0
                            for tx, ty, radius in self.occupied
                        )
                        near = any(np.hypot(car.x - px, car.y - py) < (2.5 if slant else 6.0) for car in self.parked)
                        if not blocked and not near:
                            flip = np.pi if rng.random() < 0.5 else 0.0
                            self._car(px, py, float(angle + slant + flip + rng.normal(scale=0.03)))

    # ---- buildings, walls, furniture, trees

    def _buildings(self, density: float, pavement: float) -> None:
        rng = self.rng
        setback = pavement + rng.uniform(0.5, 8.0)
        for x, y, yaw in self._beside_roads(11.0, setback, setback + rng.uniform(0.5, 14.0)):
            if rng.random() > density:
                continue
            width, depth, height = rng.uniform(8.0, 34.0), rng.uniform(6.0, 20.0), rng.uniform(3.0, 22.0)
            angle = yaw + (rng.uniform(-0.6, 0.6) if rng.random() < 0.15 else 0.0)
            cx, cy = x + depth / 2 * np.sin(yaw), y - depth / 2 * np.cos(yaw)
            outline = _outline(cx, cy, angle, width, depth)
            radius = 0.5 * float(np.hypot(width, depth))
            if not (self._off_road(outline, pavement) and self._free(cx, cy, 0.8 * radius)):
                continue
            z = self._z(cx, cy)
            self.occupied.append((cx, cy, 0.8 * radius))
            shade = float(rng.uniform(0.2, 0.8))
            self.parts.append(box((cx, cy, z + height / 2 - 1), (width, depth, height + 2), angle, shade))
            for _ in range(int(rng.integers(0, 5))):  # bays, steps, porches, columns on the side facing the road
                along, out = rng.uniform(-width / 2, width / 2), depth / 2 + rng.uniform(0.0, 0.6)
                size = (rng.uniform(0.4, 5.0), rng.uniform(0.3, 1.6), rng.uniform(0.3, 3.0))
                px, py = (
                    cx + along * np.cos(angle) - out * np.sin(angle),
                    cy + along * np.sin(angle) + out * np.cos(angle),
                )
                self.parts.append(box((px, py, z + size[2] / 2), size, angle, shade))

    def _walls(self, density: float) -> None:
        rng = self.rng
        for x, y, yaw in self._beside_roads(18.0, 2.5, 12.0):
            if rng.random() > 0.5 * density:
                continue
            length, height = rng.uniform(4.0, 22.0), rng.uniform(0.5, 2.6)
            angle = yaw + (np.pi / 2 if rng.random() < 0.3 else 0.0)
            if not self._off_road(_outline(x, y, angle, length, 0.4), 1.0) or not self._free(x, y, 1.0):
                continue
            z = self._z(x, y)
            if rng.random() < 0.35:  # a hedge
                for at in np.arange(-length / 2, length / 2, 1.2):
                    center = (x + at * np.cos(angle), y + at * np.sin(angle), z + height / 2)
                    self.parts.append(leaves(center, (0.9, 0.6, height / 2), 14, rng, 0.5))
            else:
                wall = box((x, y, z + height / 2), (length, rng.uniform(0.05, 0.4), height), angle, 0.4)
                fence = 0.6 if rng.random() < 0.3 else 0.0
                self.parts.append(replace(wall, transmission=np.full(len(wall), fence, dtype=np.float32)))

    def _street_furniture(self, pavement: float, density: float) -> None:
        rng = self.rng
        for x, y, yaw in self._beside_roads(9.0, 0.5, max(1.0, pavement)):
            if rng.random() > 0.25 + 0.4 * density or not self._free(x, y, 0.8):
                continue
            z = self._z(x, y)
            what = rng.choice(["pole", "sign", "light", "box", "person", "bollards", "shelter", "bush"], p=_FURNITURE)
            if what in ("pole", "light"):
                height = rng.uniform(3.0, 8.0)
                self.parts.append(cylinder((x, y, z + height / 2), rng.uniform(0.05, 0.22), height, 0.5))
                if what == "light":  # an arm over the road; its head is above the field of view of most sensors
                    reach = rng.uniform(1.5, 5.0)
                    center = (x - reach / 2 * np.sin(yaw), y + reach / 2 * np.cos(yaw), z + height - 0.2)
                    self.parts.append(box(center, (0.15, reach, 0.15), yaw, 0.5))
                    self.parts.append(box((x, y, z + 2.6), (0.3, 0.3, 0.9), yaw, 0.4))
            elif what == "sign":
                height = rng.uniform(1.8, 3.0)
                self.parts.append(cylinder((x, y, z + height / 2), 0.04, height, 0.6))
                self.parts.append(
                    box((x, y, z + height), (0.05, rng.uniform(0.4, 1.2), rng.uniform(0.4, 1.0)), yaw, 0.9)
                )
            elif what == "box":  # bins, cabinets, benches, planters, containers
                size = rng.uniform((0.4, 0.4, 0.4), (2.6, 1.4, 1.6))
                self.parts.append(box((x, y, z + size[2] / 2), size, yaw + rng.normal(scale=0.2), 0.5))
            elif what == "person":
                self._person(x, y, z)
            elif what == "bollards":
                for at in range(int(rng.integers(2, 6))):
                    px, py = x + 1.5 * at * np.cos(yaw), y + 1.5 * at * np.sin(yaw)
                    self.parts.append(cylinder((px, py, z + 0.45), 0.09, 0.9, 0.6, sides=6))
            elif what == "shelter":
                angle = yaw
                back = (x + 0.7 * np.sin(yaw), y - 0.7 * np.cos(yaw))
                self.parts.append(box((*back, z + 1.2), (rng.uniform(2.5, 4.5), 0.08, 2.3), angle, 0.3))
                self.parts.append(box((x, y, z + 2.4), (4.0, 1.5, 0.1), angle, 0.4))
                self.parts.append(box((*back, z + 0.45), (2.0, 0.4, 0.1), angle, 0.4))
            else:
                self.parts.append(leaves((x, y, z + 0.5), rng.uniform((0.4, 0.4, 0.3), (1.6, 1.2, 0.9)), 30, rng, 0.35))

    def _person(self, x: float, y: float, z: float) -> None:
        height = self.rng.uniform(1.5, 1.9)
        self.parts.append(ellipsoid((x, y, z + 0.62 * height), (0.17, 0.24, 0.25 * height), 0.4))
        self.parts.append(ellipsoid((x, y, z + 0.93 * height), (0.1, 0.1, 0.12), 0.5))
        for side in (-0.1, 0.1):
            step = self.rng.uniform(-0.2, 0.2)
            self.parts.append(cylinder((x + step, y + side, z + 0.22 * height), 0.08, 0.45 * height, 0.3, sides=6))

    def _trees(self, density: float, pavement: float) -> None:
        rng = self.rng
        for x, y, _ in self._beside_roads(9.0, max(0.7, pavement - 1.0), pavement + 12.0):
            if rng.random() > 0.7 * density or not self._free(x, y, 0.7):
                continue
            z = self._z(x, y)
            height = rng.uniform(3.5, 11.0)
            trunk = rng.uniform(1.6, 0.5 * height + 0.6)
            self.parts.append(cylinder((x, y, z + trunk / 2), rng.uniform(0.08, 0.35), trunk + 0.5, 0.3))
            radius = rng.uniform(0.8, 0.3 * height + 0.3)
            crown = max(0.8, (height - trunk) / 2)
            self.parts.append(leaves((x, y, z + trunk + crown), (radius, radius, crown), 70, rng, 0.7))


_FURNITURE = (0.25, 0.15, 0.13, 0.15, 0.14, 0.05, 0.03, 0.1)


def _outline(x: float, y: float, yaw: float, length: float, width: float) -> FloatArray:
    """(16, 2) points around a rectangle."""
    share = np.linspace(-0.5, 0.5, 5)[:-1]
    edge = np.concatenate(
        [
            np.column_stack([share, np.full(4, -0.5)]),
            np.column_stack([np.full(4, 0.5), share]),
            np.column_stack([-share, np.full(4, 0.5)]),
            np.column_stack([np.full(4, -0.5), -share]),
        ]
    ) * [length, width]
    c, s = np.cos(yaw), np.sin(yaw)
    outline: FloatArray = edge @ np.array([[c, s], [-s, c]]) + [x, y]
    return outline
