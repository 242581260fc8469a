"""Rebuild the road networks stored in `cobevglue.simulation`: seven kinds, each in several seeded variants.

    pip install eclipse-sumo && python tools/build_networks.py

Required only to change the networks: simulation with the stored files needs only libsumo. Each variant is defined by
nodes, edges and connections, from which SUMO's netconvert generates lanes, junction areas, right of way and signal
plans. One version of netconvert always generates identical files.
"""

from __future__ import annotations

import gzip
import itertools
import math
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from cobevglue.simulation.road_network import NETWORK_KINDS, NETWORKS, NETWORKS_FOLDER
from cobevglue.typing import FloatArray

_EXTENT = 190.0  # distance from the centre to the end of the roads [m]
_TOWN, _RESIDENTIAL, _HIGHWAY, _RAMP = 13.9, 8.3, 30.6, 19.4  # speed limits [m/s]
_POINT_SPACING = 8.0  # spacing of the points of curved roads [m]


@dataclass
class Plan:
    """Plain SUMO input; `edge` and the others add one XML element each."""

    nodes: list[str] = field(default_factory=list)
    edges: list[str] = field(default_factory=list)
    connections: list[str] = field(default_factory=list)
    last_part: dict[str, str] = field(default_factory=dict)
    """Return netconvert's name of the last part of a split edge."""

    def node(self, name: str, xy: FloatArray, **attributes: object) -> None:
        """Add a node: a position where roads begin, meet or end."""
        self.nodes.append(_element("node", id=name, x=f"{xy[0]:.2f}", y=f"{xy[1]:.2f}", **attributes))

    def edge(
        self,
        name: str,
        start: str,
        end: str,
        shape: FloatArray,
        lanes: int,
        speed: float,
        width: float,
        split: float = 0.0,
        pocket: int = 0,
        priority: int = 5,
    ) -> None:
        """Add a directed road, optionally split into two edges: before its end, or after its start if negative.

        In SUMO all lanes of an edge have the same length. On an edge of which only a part is curved, vehicles that
        change lanes would therefore jump forwards or backwards; splitting the edge where the curve begins avoids this.
        The leftmost `pocket` lanes exist only after the split.
        """
        points = " ".join(f"{x:.2f},{y:.2f}" for x, y in shape)
        splits = ""
        if split:
            before, after = (" ".join(str(lane) for lane in range(lanes - closed)) for closed in (pocket, 0))
            splits = _element("split", pos=0, lanes=before) + _element("split", pos=f"{-split:.2f}", lanes=after)
            self.last_part[name] = f"{name}.{math.trunc(-split)}"
        ends = {"from": start, "to": end, "shape": points, "numLanes": lanes, "priority": priority}
        text = _element("edge", id=name, **ends, speed=f"{speed:.2f}", width=f"{width:.2f}")
        self.edges.append(text[:-2] + ">" + splits + "</edge>" if splits else text)

    def connect(self, start: str, end: str, *lanes: tuple[int, int]) -> None:
        """Connect a lane of one edge to a lane of the next."""
        for a, b in lanes:
            self.connections.append(_element("connection", **{"from": start, "to": end, "fromLane": a, "toLane": b}))


def junction(rng: np.random.Generator, variant: int) -> Plan:
    """Return a four-arm signalised junction with left-turn lanes on some arms."""
    plan = Plan()
    plan.node("c", np.zeros(2), type="traffic_light")
    angles = np.arange(4) * math.pi / 2 + rng.uniform(-0.3, 0.3, 4) + rng.uniform(0, math.pi / 2)
    main, width = 2 + variant % 2, rng.uniform(3.1, 3.75)
    side = int(rng.integers(1, main + 1))
    for arm, angle in enumerate(angles):
        pocket = float(rng.uniform(40, 70)) if rng.random() < 0.6 or arm % 2 == 0 else 0.0
        _arm(plan, f"{arm}", angle, rng, main if arm % 2 == 0 else side, width, pocket)
    return plan


def t_junction(rng: np.random.Generator, variant: int) -> Plan:
    """Return a junction of a through road and a side road, with priority or signals."""
    plan = Plan()
    plan.node("c", np.zeros(2), type="traffic_light" if variant % 2 else "priority")
    turned, width = rng.uniform(0, 2 * math.pi), rng.uniform(3.0, 3.6)
    bend, side = rng.uniform(-0.35, 0.35), math.pi / 2 + rng.uniform(-0.45, 0.45)
    main = 1 + variant // 2 % 2
    for arm, angle in enumerate((0.0, math.pi + bend, side)):
        lanes = main if arm < 2 else 1
        pocket = float(rng.uniform(30, 50)) if arm == 1 or (arm == 2 and rng.random() < 0.5) else 0.0
        _arm(plan, f"{arm}", turned + angle, rng, lanes, width, pocket, priority=9 if arm < 2 else 3)
    return plan


def roundabout(rng: np.random.Generator, variant: int) -> Plan:
    """Return a roundabout with three to five arms."""
    plan = Plan()
    arms, ring_lanes = 3 + variant % 3, 1 + (variant // 2) % 2
    radius = float(rng.uniform(15, 20) + 3 * (arms - 3) + 8 * (ring_lanes - 1))
    width = rng.uniform(3.2, 3.75)
    spread = 2 * math.pi / arms
    angles = np.arange(arms) * spread + rng.uniform(-0.14, 0.14, arms) * spread + rng.uniform(0, 2 * math.pi)
    half = (
        5.0 + 3.5 * ring_lanes
    ) / radius  # angle between an arm's centre line and its entry and exit at the ring [rad]
    on_ring = [
        (f"{kind}{arm}", angles[arm] + sign * half) for arm in range(arms) for kind, sign in (("x", -1), ("e", 1))
    ]
    for name, angle in on_ring:
        plan.node(name, radius * _unit(angle))
    for (start, a), (end, b) in zip(on_ring, on_ring[1:] + on_ring[:1], strict=True):
        b = a + (b - a) % (2 * math.pi)
        steps = np.linspace(a, b, max(3, round((b - a) * radius / 4)))
        plan.edge(f"ring_{start}", start, end, radius * _units(steps), ring_lanes, 8.3, width + 0.4, priority=9)
    for arm, angle in enumerate(angles):
        line = _line(radius + 6.0 + 10.0 * ring_lanes, _EXTENT, angle, rng.uniform(-0.003, 0.003))
        plan.node(f"n{arm}", line[-1])
        entry, exit_ = (radius * _unit(dict(on_ring)[f"{kind}{arm}"]) for kind in "ex")
        # Entry and exit meet the ring at an oblique angle.
        flare_in = _bend(line[0], -_unit(angle), entry, _unit(angle + half + math.pi / 2) - 1.2 * _unit(angle + half))
        flare_out = _bend(exit_, _unit(angle - half + math.pi / 2) + 1.2 * _unit(angle - half), line[0], _unit(angle))
        plan.node(f"f{arm}", line[0])
        for name, start, end, shape in (
            (f"in{arm}", f"n{arm}", f"f{arm}", line[::-1]),
            (f"flare_in{arm}", f"f{arm}", f"e{arm}", flare_in),
            (f"flare_out{arm}", f"x{arm}", f"f{arm}", flare_out),
            (f"out{arm}", f"f{arm}", f"n{arm}", line),
        ):
            plan.edge(name, start, end, shape, ring_lanes, _TOWN, width, priority=3)
    return plan


def highway(rng: np.random.Generator, variant: int) -> Plan:
    """Return a motorway with two carriageways, each with an exit and an entry."""
    plan = Plan()
    lanes, width = 3 + variant % 2, rng.uniform(3.5, 3.75)
    turned, curvature, median = rng.uniform(0, 2 * math.pi), rng.uniform(-1, 1) / 900, rng.uniform(1.5, 4.0)
    reach = _EXTENT + 30.0
    ahead = _line(0.0, reach, turned, curvature)
    # Left of the road's centre line, so that the two halves have the same direction at the centre.
    behind = _line(0.0, reach, turned + math.pi, -curvature)
    middle = np.vstack([behind[:0:-1], ahead])
    for side, line in (("a", middle), ("b", middle[::-1])):
        line = _shifted(line, median)
        cuts = np.array([0.0, 0.18, 0.42, 0.58, 0.82, 1.0]) + np.r_[0.0, rng.uniform(-0.03, 0.03, 4), 0.0]
        parts = _cut(line, cuts)
        plan.node(f"{side}5", line[-1])
        for index, part in enumerate(parts):
            # Between entry and exit the carriageway has one additional lane on the right; the left lane is unchanged.
            plan.node(f"{side}{index}", part[0], type="priority")
            here, before = (lanes + (at in (1, 3)) for at in (index, index - 1))
            plan.edge(
                f"{side}{index}", f"{side}{index}", f"{side}{index + 1}", part, here, _HIGHWAY, width, priority=12
            )
            if index:
                pairs = [(before - k, here - k) for k in range(1, lanes + 1)]  # counted from the left
                plan.connect(f"{side}{index - 1}", f"{side}{index}", *pairs)
        away = rng.uniform(0.35, 0.6) / 120.0
        for kind, node, along in (("entry", 1, -1), ("exit", 4, 1)):
            ahead = _direction(parts[node][:2])
            right = np.array([ahead[1], -ahead[0]])
            angle = math.atan2(*(along * ahead)[::-1]) - along * 0.12
            ramp = parts[node][0] + width * lanes * right + _line(0.0, 120.0, angle, -along * away)
            plan.node(f"{side}{kind}", ramp[-1])
            ends = (f"{side}{node}", f"{side}{kind}")
            if kind == "entry":
                plan.edge(f"{side}entry", *ends[::-1], ramp[::-1], 1, _RAMP, width, priority=7)
                plan.connect(f"{side}entry", f"{side}1", (0, 0))
            else:
                plan.edge(f"{side}exit", *ends, ramp, 1, _RAMP, width, priority=7)
                plan.connect(f"{side}3", f"{side}exit", (0, 0))
    return plan


def residential(rng: np.random.Generator, variant: int) -> Plan:
    """Return a narrow winding street with side streets."""
    plan = Plan()
    width, kind = rng.uniform(3.0, 3.3), "right_before_left" if variant % 2 else "priority"
    turned, waves, phase = rng.uniform(0, 2 * math.pi), rng.uniform(0.3, 0.7), rng.uniform(0, 2 * math.pi)
    along = np.linspace(-_EXTENT, _EXTENT, 49)
    swing = 24.0 * (np.sin(2 * math.pi * waves * along / _EXTENT + phase) - np.sin(phase))
    street = np.column_stack([along, swing]) @ np.array([_unit(turned), _unit(turned + math.pi / 2)])
    sides = 3 + variant % 3
    cuts = 0.15 + 0.7 * (np.arange(sides) + 0.5 + rng.uniform(-0.25, 0.25, sides)) / sides
    parts = _cut(street, np.r_[0.0, cuts, 1.0])
    for index, part in enumerate(parts):
        inside = index > 0
        plan.node(f"m{index}", part[0], **({"type": kind} if inside else {}))
    plan.node(f"m{sides + 1}", street[-1])
    for index, part in enumerate(parts):
        start, end = f"m{index}", f"m{index + 1}"
        plan.edge(f"main{index}", start, end, part, 1, _RESIDENTIAL, width, priority=5)
        plan.edge(f"back{index}", end, start, part[::-1], 1, _RESIDENTIAL, width, priority=5)
    first = int(rng.integers(2))
    taken = [street]
    for index in range(1, sides + 1):
        heading = math.atan2(*_direction(parts[index][:2])[::-1])
        for sign in (1, -1) if rng.random() < 0.35 else ((1,) if (index + first) % 2 else (-1,)):
            while True:
                angle = heading + sign * (math.pi / 2 + rng.uniform(-0.3, 0.3))
                side = parts[index][0] + _line(0.0, rng.uniform(70, 140), angle, rng.uniform(-0.005, 0.005))
                apart = np.vstack(taken)[:, None] - side[None, 4:]
                if np.hypot(*apart.T).min() > 20.0:
                    break
            taken.append(side)
            name = f"{index}{'l' if sign > 0 else 'r'}"
            plan.node(f"s{name}", side[-1])
            plan.edge(f"from{name}", f"s{name}", f"m{index}", side[::-1], 1, _RESIDENTIAL, width, priority=3)
            plan.edge(f"to{name}", f"m{index}", f"s{name}", side, 1, _RESIDENTIAL, width, priority=3)
    return plan


def town(rng: np.random.Generator, variant: int) -> Plan:
    """Return a grid of streets with one to three lanes per direction; crossings of wide streets have signals."""
    plan = Plan()
    turned, width = rng.uniform(0, 2 * math.pi), rng.uniform(3.1, 3.6)
    axes = _unit(turned), _unit(turned + math.pi / 2)
    crossed = 2 + variant % 2, 2 + variant // 2 % 2  # number of streets along each axis
    places = [_places(rng, number) for number in crossed]
    lanes = [rng.integers(1, 4, size=number) for number in crossed]
    lanes[variant % 2][0] = 2 + variant % 2  # at least one street is wide
    at: dict[str, FloatArray] = {}
    for i, x in enumerate(places[0]):
        for j, y in enumerate(places[1]):
            wide = max(lanes[0][i], lanes[1][j]) > 1
            at[f"c{i}{j}"] = (x + rng.uniform(-5, 5)) * axes[0] + (y + rng.uniform(-5, 5)) * axes[1]
            kind = "traffic_light" if wide or rng.random() < 0.3 else "priority"
            plan.node(f"c{i}{j}", at[f"c{i}{j}"], type=kind)
    for axis in (0, 1):
        for street, place in enumerate(places[axis]):
            ends = [f"n{axis}{street}{sign}" for sign in (-1, 1)]
            for name, sign in zip(ends, (-1, 1), strict=True):
                at[name] = place * axes[axis] + sign * _EXTENT * axes[1 - axis]
                plan.node(name, at[name])
            crossings = [f"c{street}{k}" if axis == 0 else f"c{k}{street}" for k in range(crossed[1 - axis])]
            for a, b in itertools.pairwise([ends[0], *crossings, ends[1]]):
                for start, end in ((a, b), (b, a)):
                    _street(plan, start, end, at, rng, int(lanes[axis][street]), width)
    return plan


def crossing(rng: np.random.Generator, variant: int) -> Plan:
    """Return a signalised crossing of two wide streets; each arm has one or two left-turn lanes opposite each other.

    The centre line of a street shifts to make room for these lanes, in opposite directions on the two sides of the
    crossing. Unlike in a `junction`, oncoming vehicles are therefore not left of the extended centre line.
    """
    plan = Plan()
    plan.node("c", np.zeros(2), type="traffic_light")
    angles = np.arange(4) * math.pi / 2 + rng.uniform(-0.15, 0.15, 4) + rng.uniform(0, math.pi / 2)
    width = rng.uniform(3.1, 3.5)
    through = rng.integers(2, 4, size=2)
    turning = 1 + variant % 2, int(rng.integers(1, 3))
    for arm, angle in enumerate(angles):
        ahead, left, beside = int(through[arm % 2]), turning[arm % 2], int(through[1 - arm % 2])
        aside = width * (left / 2 + rng.uniform(0.0, 0.5))
        _arm(plan, f"{arm}", angle, rng, ahead, width, float(rng.uniform(40, 70)), left, aside)
        near = plan.last_part[f"in{arm}"]
        plan.connect(near, f"out{(arm + 1) % 4}", (0, 0))
        plan.connect(near, f"out{(arm + 2) % 4}", *((lane, lane) for lane in range(ahead)))
        plan.connect(near, f"out{(arm + 3) % 4}", *((ahead + k, beside - left + k) for k in range(left)))
    return plan


_BUILDERS: dict[str, Callable[[np.random.Generator, int], Plan]] = {
    "junction": junction,
    "t_junction": t_junction,
    "roundabout": roundabout,
    "highway": highway,
    "residential": residential,
    "town": town,
    "crossing": crossing,
}


def _places(rng: np.random.Generator, number: int) -> FloatArray:
    """Return the sorted distances of parallel streets from a town's centre [m]."""
    gaps = rng.uniform(60, 110, number - 1)
    return np.r_[0.0, np.cumsum(gaps)] - gaps.sum() / 2 + rng.uniform(-20, 20)


def _street(
    plan: Plan, start: str, end: str, at: dict[str, FloatArray], rng: np.random.Generator, lanes: int, width: float
) -> None:
    """Add a straight one-way road between two nodes, optionally with a left-turn lane before a crossing."""
    shape = np.array([at[start], at[end]])
    pocket = end.startswith("c") and np.hypot(*(shape[1] - shape[0])) > 55 and rng.random() < 0.4
    split = float(rng.uniform(22, 35)) if pocket else 0.0
    plan.edge(f"{start}_{end}", start, end, shape, lanes + pocket, _TOWN, width, split, pocket, priority=3 + 2 * lanes)


def _arm(
    plan: Plan,
    name: str,
    angle: float,
    rng: np.random.Generator,
    lanes: int,
    width: float,
    pocket: float,
    turning: int = 1,
    aside: float = 0.0,
    priority: int = 5,
) -> None:
    """Add a straight or curved road outwards from the node "c", with `lanes` per direction.

    `turning` additional left-turn lanes exist over the length `pocket`, where the centre line is shifted by `aside`.
    """
    curvature = float(rng.choice([0.0, 1.0, -1.0])) * rng.uniform(1 / 500, 1 / 180)
    straight, end = pocket or 50.0, f"n{name}"
    line = _line(0.0, _EXTENT, angle, curvature, straight)
    plan.node(end, line[-1])
    if aside:
        along = np.r_[0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T))]
        line = _shifted(line, aside * (1.0 + np.cos(np.pi * np.clip((along - straight) / 40.0 - 0.3, 0.0, 1.0))) / 2.0)
    arriving, more = line[::-1], turning if pocket else 0
    plan.edge(f"in{name}", end, "c", arriving, lanes + more, _TOWN, width, straight, more, priority=priority)
    plan.edge(f"out{name}", "c", end, line, lanes, _TOWN, width, -straight, priority=priority)


def _line(start: float, end: float, angle: float, curvature: float, straight: float = 0.0) -> FloatArray:
    """Return (N, 2) points of a line that starts at distance `start` from the origin in this direction, then curves."""
    along = np.linspace(start, end, max(2, math.ceil((end - start) / _POINT_SPACING) + 1))
    heading = angle + curvature * np.maximum(along - start - straight, 0.0)
    steps = np.diff(along)[:, None] * _units((heading[:-1] + heading[1:]) / 2)
    return np.vstack([[0.0, 0.0], np.cumsum(steps, axis=0)]) + start * _unit(angle)


def _bend(start: FloatArray, leaving: FloatArray, end: FloatArray, arriving: FloatArray) -> FloatArray:
    """Return (N, 2) points of a Bézier curve between two points with these directions."""
    reach = 0.45 * np.hypot(*(end - start))
    a = start + reach * leaving / np.hypot(*leaving)
    b = end - reach * arriving / np.hypot(*arriving)
    t = np.linspace(0.0, 1.0, 9)[:, None]
    curve: FloatArray = (1 - t) ** 3 * start + 3 * t * (1 - t) ** 2 * a + 3 * t**2 * (1 - t) * b + t**3 * end
    return curve


def _cut(line: FloatArray, shares: FloatArray) -> list[FloatArray]:
    """Return the pieces of a line between these fractions of its length."""
    length = np.r_[0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T))]
    pieces = []
    for low, high in zip(shares[:-1] * length[-1], shares[1:] * length[-1], strict=True):
        inside = line[(length > low + 1.0) & (length < high - 1.0)]
        ends = [[np.interp(at, length, line[:, axis]) for axis in (0, 1)] for at in (low, high)]
        pieces.append(np.vstack([ends[0], inside, ends[1]]))
    return pieces


def _shifted(line: FloatArray, right: float | FloatArray) -> FloatArray:
    """Shift a line to its right, by one distance or by (N,) distances of its points."""
    tangent = np.gradient(line, axis=0)
    tangent /= np.hypot(*tangent.T)[:, None]
    moved: FloatArray = line + np.reshape(right, (-1, 1)) * np.column_stack([tangent[:, 1], -tangent[:, 0]])
    return moved


def _direction(two: FloatArray) -> FloatArray:
    step: FloatArray = two[1] - two[0]
    return step / float(np.hypot(*step))


def _unit(angle: float) -> FloatArray:
    return np.array([math.cos(angle), math.sin(angle)])


def _units(angle: FloatArray) -> FloatArray:
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _element(tag: str, **attributes: object) -> str:
    return f"<{tag} " + " ".join(f"{key}={quoteattr(str(value))}" for key, value in attributes.items()) + "/>"


def build(plan: Plan, file: Path) -> None:
    """Run netconvert on a plan and store the network."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        for tag, elements in (("node", plan.nodes), ("edge", plan.edges), ("connection", plan.connections)):
            (work / f"{tag}.xml").write_text(f"<{tag}s>\n" + "\n".join(elements) + f"\n</{tag}s>\n")
        command = [str(Path(sys.executable).with_name("netconvert"))]
        command += ["--node-files", "node.xml", "--edge-files", "edge.xml", "--connection-files", "connection.xml"]
        command += ["--output-file", "net.xml", "--no-turnarounds", "--offset.disable-normalization"]
        command += ["--junctions.corner-detail", "6", "--junctions.internal-link-detail", "8", "--precision", "2"]
        command += ["--tls.green.time", "20", "--no-turnarounds.geometry", "--aggregate-warnings", "3"]
        subprocess.run(command, cwd=work, check=True, stdout=subprocess.DEVNULL)
        text = (work / "net.xml").read_text()
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL)  # the build date
    file.write_bytes(gzip.compress(text.encode(), mtime=0))


def main() -> None:
    """Build all networks."""
    NETWORKS_FOLDER.mkdir(exist_ok=True)
    for split_index, (split, names) in enumerate(NETWORKS.items()):
        for name in names:
            kind, _, index = name.partition(f"_{split}_")
            rng = np.random.default_rng([NETWORK_KINDS.index(kind), split_index, int(index)])
            # Variant numbers continue across the splits, so that validation and test variants differ from training.
            variant = int(index) + 4 * split_index
            file = NETWORKS_FOLDER / f"{name}.net.xml.gz"
            build(_BUILDERS[kind](rng, variant), file)
            print(f"{file.name}: {file.stat().st_size / 1000:.1f} kB")


if __name__ == "__main__":
    main()
