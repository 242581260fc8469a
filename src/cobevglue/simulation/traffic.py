"""Traffic on a stored road network, simulated with SUMO.

    with Traffic("junction_train_0", seed=1) as traffic:
        for _ in range(100):
            traffic.step(0.1)
            now = traffic.vehicles()
            now.x, now.y, now.yaw, now.length      # boxes on the ground, world frame

SUMO models car following, queues, right of way and lane changes. Requires libsumo (`pip install
cobevglue[simulation]`), which supports one simulation per process; hence one open `Traffic` at a time.
"""

from __future__ import annotations

import io
import math
import tempfile
import weakref
from collections import Counter
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from cobevglue.boxes import Boxes
from cobevglue.se2 import wrap_angle
from cobevglue.settings import Settings
from cobevglue.simulation.road_network import RoadNetwork, network_file
from cobevglue.typing import FloatArray, IntArray, StrArray

__all__ = ["VEHICLE_KINDS", "Traffic", "TrafficSettings", "TrafficSnapshot"]

_TRAFFIC_STREAM = 0
_STEP = 0.1  # SUMO's time step [s]
_STEPS_PER_DEMAND = 5  # steps between replacements of departed vehicles
_SPACE_PER_VEHICLE = 13.0  # minimum lane length per vehicle: denser traffic jams [m]
_EDGE_MARGIN = 0.15  # minimum distance of vehicles with a lateral offset from the lane's edge [m]
_LATERAL_RESOLUTION = 0.8  # enables SUMO's sublane model: lateral offsets and gradual lane changes [m]
_MAX_DEPART_DELAY = 2.0  # vehicles that cannot be inserted are discarded after this time [s]


class _Kind(NamedTuple):
    """A kind of vehicle: share, ranges of its dimensions [m], SUMO's class and limits of its motion."""

    share: float
    length: tuple[float, float]
    width: tuple[float, float]
    height: tuple[float, float]
    sumo_class: str
    acceleration: float  # [m/s^2]
    top_speed: float  # [m/s]


_KINDS = MappingProxyType(
    {
        "hatchback": _Kind(0.24, (3.5, 4.4), (1.75, 2.05), (1.4, 1.6), "passenger", 2.6, 50.0),
        "sedan": _Kind(0.22, (4.4, 5.2), (1.8, 2.15), (1.38, 1.52), "passenger", 2.6, 50.0),
        "suv": _Kind(0.20, (4.2, 5.1), (1.85, 2.2), (1.58, 1.9), "passenger", 2.6, 50.0),
        "coupe": _Kind(0.05, (4.1, 4.8), (1.8, 2.1), (1.3, 1.42), "passenger", 3.5, 55.0),
        "jeep": _Kind(0.04, (3.8, 4.8), (1.8, 2.1), (1.7, 1.95), "passenger", 2.4, 40.0),
        "pickup": _Kind(0.05, (5.0, 5.4), (1.9, 2.25), (1.75, 1.95), "passenger", 2.4, 45.0),
        "van": _Kind(0.08, (5.0, 6.5), (2.0, 2.3), (2.0, 2.8), "delivery", 2.0, 40.0),
        "truck": _Kind(0.06, (7.0, 12.0), (2.4, 2.7), (2.8, 3.9), "truck", 1.3, 25.0),
        "bus": _Kind(0.03, (10.0, 13.0), (2.5, 2.6), (3.0, 3.4), "bus", 1.2, 25.0),
        "motorcycle": _Kind(0.03, (1.9, 2.4), (0.7, 0.95), (1.4, 1.8), "motorcycle", 4.0, 50.0),
    }
)

VEHICLE_KINDS = tuple(_KINDS)
"""Kinds of vehicle."""

_RESIDENTIAL_FACTORS = MappingProxyType({"truck": 0.3, "bus": 0.3})  # of their shares in a residential area

# Ranges of the speed, relative to the speed limits, and of the number of vehicles per 100 m of lane.
_FLOW = MappingProxyType(
    {
        "junction": ((0.8, 1.1), (1.2, 4.2)),
        "t_junction": ((0.8, 1.1), (1.8, 5.0)),
        "roundabout": ((0.8, 1.1), (1.8, 5.0)),
        "highway": ((0.25, 1.0), (1.0, 4.0)),
        "residential": ((0.7, 1.1), (1.2, 3.2)),
        "town": ((0.8, 1.1), (1.0, 3.5)),
        "crossing": ((0.8, 1.1), (1.5, 4.5)),
    }
)

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class TrafficSettings(Settings):
    """Settings of the traffic.

    Attributes:
        vehicles: target number of vehicles on the network; None: random, from light traffic to queues.
        speed_factor: factor of the speed limits; None: random. Low values congest highways.
        warm_up: simulated time before the scene begins [s].
        lateral_offset: maximum offset of vehicles from the centre of their lane, where it is wide enough [m].

    Raises:
        ValueError: a value out of its range, or an unknown field.
    """

    vehicles: Annotated[int, Field(ge=1, le=1000)] | None = None
    speed_factor: _Positive | None = None
    warm_up: _NotNegative = 20.0
    lateral_offset: _NotNegative = 0.3


@dataclass(frozen=True, eq=False, slots=True)
class TrafficSnapshot:
    """N vehicles at one time, in the world frame (x east, y north), by id.

    Attributes:
        time: since the scene began [s].
        id: (N,) unique id, constant while the vehicle is on the network and never reused.
        kind: (N,) one of `VEHICLE_KINDS`.
        length: (N,) [m].
        width: (N,) over the mirrors [m].
        height: (N,) above the ground [m].
        x: (N,) centre of the box [m].
        y: (N,) centre of the box [m].
        yaw: (N,) heading from x towards y [rad].
        speed: (N,) [m/s].
    """

    time: float
    id: IntArray
    kind: StrArray
    length: FloatArray
    width: FloatArray
    height: FloatArray
    x: FloatArray
    y: FloatArray
    yaw: FloatArray
    speed: FloatArray

    def __len__(self) -> int:
        return len(self.id)

    def boxes(self) -> Boxes:
        """The vehicles as boxes on the plane z = 0, with track ids and labels."""
        return Boxes(
            center=np.column_stack([self.x, self.y, self.height / 2]),
            size=np.column_stack([self.length, self.width, self.height]),
            yaw=self.yaw,
            track_id=self.id,
            label=self.kind,
        )


class _Vehicle(NamedTuple):
    """Constants of a vehicle: its kind, and length, width, height [m]."""

    kind: str
    size: tuple[float, float, float]


class Traffic:
    """A running traffic simulation, determined by network, seed, settings and steps.

    Attributes:
        network: name of the stored network.
        seed: integer >= 0.
        settings: of the traffic.
        roads: geometry of the network.
        target: target number of vehicles on the network, limited by the length of its lanes.

    Raises:
        ValueError: unknown network; the message suggests the nearest one.
        ModuleNotFoundError: libsumo is not installed.
        RuntimeError: another `Traffic` is open in this process.
    """

    def __init__(self, network: str, seed: int = 0, settings: TrafficSettings | None = None) -> None:
        self.network = network
        self.seed = seed
        self.settings = settings = settings or TrafficSettings()
        self.roads = RoadNetwork.load(network)
        self._rng = rng = np.random.default_rng([seed, _TRAFFIC_STREAM, 0])
        speed_range, density_range = _FLOW[self.roads.kind]
        drawn_speed, drawn_density = rng.uniform(*speed_range), rng.uniform(*density_range)
        lanes = [lane for lane in self.roads.lanes if not lane.internal]
        road = sum(lane.length for lane in lanes)
        target = round(road * drawn_density / 100.0) if settings.vehicles is None else settings.vehicles
        self.target = max(1, min(target, int(road / _SPACE_PER_VEHICLE)))
        self._min_lane_width = min(lane.width for lane in lanes)
        self._vehicles: dict[str, _Vehicle] = {}
        self._routes: dict[tuple[str, ...], str] = {}
        self._steps = self._recorded_from = 0
        self._sumo = _open_libsumo(self)
        try:
            self._start(drawn_speed if settings.speed_factor is None else settings.speed_factor)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Traffic:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the simulation, so that another can be opened."""
        global _open
        if _open is not None and _open() is self:
            _open = None
            self._sumo.close()

    @property
    def time(self) -> float:
        """Time since the scene began [s]."""
        return (self._steps - self._recorded_from) * _STEP

    def step(self, seconds: float = _STEP) -> None:
        """Advance the simulation by a multiple of 0.1 s.

        Raises:
            ValueError: not a positive multiple of 0.1 s.
            RuntimeError: the simulation is closed.
        """
        self._check_open()
        steps = round(seconds / _STEP) if math.isfinite(seconds) else 0
        if steps < 1 or abs(steps * _STEP - seconds) > 1e-6:
            raise ValueError(f"seconds must be a positive multiple of {_STEP}, got {seconds}")
        for _ in range(steps):
            if self._steps and self._steps % _STEPS_PER_DEMAND == 0:
                self._replace_departed()
            self._sumo.simulationStep()
            self._steps += 1

    def vehicles(self) -> TrafficSnapshot:
        """All vehicles at the current time.

        Raises:
            RuntimeError: the simulation is closed.
        """
        self._check_open()
        vehicle = self._sumo.vehicle
        names = sorted(vehicle.getIDList(), key=int)
        constants = [self._vehicles[name] for name in names]
        front = np.array([vehicle.getPosition(name) for name in names], dtype=np.float64).reshape(-1, 2)
        # SUMO's angles are clockwise from north.
        yaw = wrap_angle(math.pi / 2 - np.radians([vehicle.getAngle(name) for name in names]))
        size = np.array([one.size for one in constants], dtype=np.float64).reshape(-1, 3)
        # SUMO's positions are at the front bumper.
        centre = front - size[:, :1] / 2 * np.column_stack([np.cos(yaw), np.sin(yaw)])
        return TrafficSnapshot(
            time=self.time,
            id=np.array(names, dtype=np.int64),
            kind=np.array([one.kind for one in constants], dtype=np.str_),
            length=size[:, 0],
            width=size[:, 1],
            height=size[:, 2],
            x=centre[:, 0],
            y=centre[:, 1],
            yaw=yaw,
            speed=np.array([vehicle.getSpeed(name) for name in names], dtype=np.float64),
        )

    def _start(self, speed_factor: float) -> None:
        """Start SUMO, insert vehicles all along the roads, and run the warm-up."""
        sumo, rng = self._sumo, self._rng
        with tempfile.TemporaryDirectory() as folder:
            types = Path(folder) / "types.add.xml"
            types.write_text(_vehicle_types())
            options = ["--net-file", str(network_file(self.network)), "--additional-files", str(types)]
            options += ["--seed", str(self.seed % 2**31), "--step-length", str(_STEP)]
            options += ["--lateral-resolution", str(_LATERAL_RESOLUTION), "--max-depart-delay", str(_MAX_DEPART_DELAY)]
            options += ["--time-to-teleport", "-1", "--collision.action", "none"]
            options += ["--no-step-log", "--no-warnings", "--duration-log.disable"]
            sumo.start(["sumo", *options])
        for lane in self.roads.lanes:
            sumo.lane.setMaxSpeed(lane.id, lane.speed_limit * speed_factor)
        for name in sumo.trafficlight.getIDList():
            phases = len(sumo.trafficlight.getAllProgramLogics(name)[0].phases)
            sumo.trafficlight.setPhase(name, int(rng.integers(phases)))
        rare = np.array(
            [1.0 if self.roads.kind != "residential" else _RESIDENTIAL_FACTORS.get(kind, 1.0) for kind in _KINDS]
        )
        shares = rare * [facts.share for facts in _KINDS.values()]
        self._kind_shares = shares / shares.sum()
        self._route_shares = self._draw_route_shares()
        self._lane_length = dict.fromkeys((lane.edge for lane in self.roads.lanes), 0.0)
        for lane in self.roads.lanes:
            self._lane_length[lane.edge] += lane.length
        for _ in range(self.target):
            self._add_vehicle(anywhere=True)
        steps = round(self.settings.warm_up / _STEP)
        if steps:
            self.step(steps * _STEP)
        self._recorded_from = self._steps

    def _draw_route_shares(self) -> FloatArray:
        """Random probability of each route: some roads are busier than others."""
        roads = Counter(lane.edge for lane in self.roads.lanes)
        ends = sorted({edge for route in self.roads.routes for edge in (route[0], route[-1])})
        busy = {edge: self._rng.uniform(0.3, 1.0) * roads[edge] for edge in ends}
        weight = np.array([busy[route[0]] * busy[route[-1]] for route in self.roads.routes])
        shares: FloatArray = weight / weight.sum()
        return shares

    def _replace_departed(self) -> None:
        """Add vehicles at the entries of the network up to the target, counting those still to be inserted."""
        vehicles = self._sumo.vehicle.getIDCount() + len(self._sumo.simulation.getPendingVehicles())
        for _ in range(self.target - vehicles):
            self._add_vehicle(anywhere=False)

    def _add_vehicle(self, anywhere: bool) -> None:
        """Request one more vehicle from SUMO, at the start of a route or anywhere on one."""
        sumo, rng = self._sumo, self._rng
        edges = self.roads.routes[int(rng.choice(len(self.roads.routes), p=self._route_shares))]
        if anywhere:
            room = np.array([self._lane_length[edge] for edge in edges])
            edges = edges[int(rng.choice(len(edges), p=room / room.sum())) :]
        if edges not in self._routes:
            self._routes[edges] = f"route{len(self._routes)}"
            sumo.route.add(self._routes[edges], edges)
        kind = VEHICLE_KINDS[int(rng.choice(len(VEHICLE_KINDS), p=self._kind_shares))]
        facts = _KINDS[kind]
        # A common draw correlates the dimensions: long vehicles tend to be wide and high.
        shares = 0.7 * rng.uniform() + 0.3 * rng.uniform(size=3)
        size = [low + share * (high - low) for share, (low, high) in zip(shares, facts[1:4], strict=True)]
        beside = min(self.settings.lateral_offset, max(0.0, (self._min_lane_width - size[1]) / 2 - _EDGE_MARGIN))
        name = str(len(self._vehicles))
        self._vehicles[name] = _Vehicle(kind, (float(size[0]), float(size[1]), float(size[2])))
        sumo.vehicle.add(
            name,
            self._routes[edges],
            typeID=kind,
            departLane="best_prob" if anywhere else "free",
            departPos="random_free" if anywhere else "base",
            departSpeed="max",
        )
        sumo.vehicle.setLength(name, size[0])
        sumo.vehicle.setWidth(name, size[1])
        sumo.vehicle.setHeight(name, size[2])
        sumo.vehicle.setMinGap(name, rng.uniform(1.2, 3.0))
        sumo.vehicle.setLateralAlignment(name, f"{rng.uniform(-beside, beside):.2f}")

    def _check_open(self) -> None:
        if _open is None or _open() is not self:
            raise RuntimeError("this Traffic is closed")


def _vehicle_types() -> str:
    """SUMO's XML of the vehicle kinds."""
    lines = []
    for kind, facts in _KINDS.items():
        # Lateral motion only while driving, and slower for long vehicles: one that stops across two lanes blocks both,
        # and SUMO ignores the additional space of rotated vehicles.
        turn = 0.2 if facts.length[1] < 6.0 else 0.08
        lines.append(
            f'<vType id="{kind}" vClass="{facts.sumo_class}" accel="{facts.acceleration}" maxSpeed="{facts.top_speed}"'
            f' lcMaxSpeedLatStanding="0" lcMaxSpeedLatFactor="{turn}"/>'
        )
    return "<additional>\n" + "\n".join(lines) + "\n</additional>\n"


_open: weakref.ref[Traffic] | None = None


def _open_libsumo(owner: Traffic) -> Any:
    """Import libsumo and register `owner` as the open simulation."""
    global _open
    try:
        with redirect_stdout(io.StringIO()):  # it warns of versions of pyarrow, which is not used here
            import libsumo
    except ModuleNotFoundError:
        raise ModuleNotFoundError("traffic needs SUMO: pip install cobevglue[simulation]") from None
    if libsumo.isLoaded():
        if _open is None or _open() is not None:
            raise RuntimeError("SUMO supports one simulation per process: close() the other Traffic first")
        libsumo.close()  # its owner was garbage-collected without close()
    _open = weakref.ref(owner)
    return libsumo
