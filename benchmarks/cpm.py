"""What ETSI's CPM and SAE's SDSM cost against our own object message: bytes, time, and alignments.

    python benchmarks/cpm.py                     # everything below, about 8 minutes
    python benchmarks/cpm.py --only bytes        # bytes and times of messages of 1, 16, 40 boxes
    python benchmarks/cpm.py --only alignment    # V2V4Real, the other car's list sent in different ways
    python benchmarks/cpm.py --only alignment --channels SDSM    # a part of it
    python benchmarks/cpm.py --json results.json
    python benchmarks/cpm.py --picture docs/images/cpm.png    # only the picture of docs/cpm.md

The data is read from $COBEVGLUE_DATA (default ../shared/data). Nothing was tuned for it. What "right" and "wrong" mean:
`cobevglue.evaluation.alignment`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from alignment import run, show
from cobevglue import BEVGlue, Boxes
from cobevglue.evaluation.alignment import AlignmentSequence, PairFrame, Record, summarise
from cobevglue.evaluation.alignment_data import (
    V2V4REAL_TRAIN,
    V2V4REAL_VAL,
    v2v4real_car_sequences,
    v2v4real_sequences,
)
from cobevglue.messages import ObjectMessage, cpm, decode, encode, sdsm
from cobevglue.se2 import SE2
from cobevglue.visualization.style import (
    EGO,
    MATCH,
    OTHER,
    add_axes,
    light_grid,
    new_figure,
    save_figure,
    set_title,
)
from common import DATA, print_head

RUNS = 6
"""With other jitter, or another direction of east."""
COUNTS = (1, 16, 40)

Table = list[dict[str, Any]]
Received = tuple[Boxes, Boxes | None]
Channel = Callable[[PairFrame], Received]


def main() -> None:
    """Print the tables and, on request, write them as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=tuple(TABLES))
    parser.add_argument("--channels", default="", help="only ways to send whose name holds this")
    parser.add_argument("--splits", nargs="+", choices=("train", "val"), default=["train", "val"])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    if arguments.picture:
        draw(arguments.picture)
        return
    print_head("seed 0")
    tables: dict[str, Table] = {}
    for name, table in TABLES.items():
        if arguments.only in (None, name):
            tables[name] = table(arguments)
            sys.stdout.flush()
    if arguments.json:
        arguments.json.write_text(json.dumps(tables, indent=1))


def sizes(_arguments: argparse.Namespace) -> Table:
    """Bytes of a message, and the time of encoding and of decoding it."""
    print("## Messages of random boxes (agent id of one character, body not sent)\n")
    table: Table = []
    for n in COUNTS:
        boxes = random_boxes(n)
        rng = np.random.default_rng([0, n, 1])
        kinematics = {"velocity": rng.normal(0.0, 10.0, (n, 2)), "age": np.full(n, 1.0)}
        accuracy = {"position_std": np.full(n, 0.2), "yaw_std": np.full(n, 0.02)}
        classes = boxes.replace(label=["car"] * n, score=rng.uniform(0.0, 1.0, n))
        own = ObjectMessage("7", 12.5, 15, boxes)
        table.append(measured(f"object message, {n} boxes", own, encode, decode))
        for what, message in (
            ("boxes only", perception(boxes, sensor_type=None)),
            ("and classes, scores", perception(classes)),
            ("and velocities, ages, accuracies", perception(classes, **kinematics, **accuracy)),
        ):
            table.append(measured(f"CPM, {n} boxes, {what}", message, cpm.encode, cpm.decode))
        for what, sent_boxes, velocity in (
            ("boxes only", boxes, None),
            ("and classes, scores, velocities", classes, kinematics["velocity"]),
        ):
            own_sdsm = sdsm.SensorDataSharing(
                7, 12.5, sent_boxes, heading=0.3, latitude=42.3, longitude=-83.0, velocity=velocity
            )
            table.append(measured(f"SDSM, {n} boxes, {what}", own_sdsm, sdsm.encode, sdsm.decode))
    show(table)
    return table


def measured(
    what: str, message: Any, encoder: Callable[[Any], bytes], decoder: Callable[[bytes], Any]
) -> dict[str, Any]:
    """Bytes, and the median time of 50 calls."""
    sent = encoder(message)
    times: dict[str, list[float]] = {"encode [ms]": [], "decode [ms]": []}
    for _ in range(50):
        start = time.perf_counter()
        encoder(message)
        middle = time.perf_counter()
        decoder(sent)
        times["encode [ms]"].append(1e3 * (middle - start))
        times["decode [ms]"].append(1e3 * (time.perf_counter() - middle))
    return {"what": what, "bytes": len(sent)} | {name: float(np.median(values)) for name, values in times.items()}


def random_boxes(n: int) -> Boxes:
    """Cars within 80 m, with track ids."""
    rng = np.random.default_rng([0, n])
    return Boxes(
        center=rng.uniform(-80.0, 80.0, (n, 3)) * [1.0, 1.0, 0.02],
        size=[4.5, 1.9, 1.6] + rng.uniform(-0.3, 0.3, (n, 3)),
        yaw=rng.uniform(-np.pi, np.pi, n),
        track_id=np.arange(n),
    )


def perception(boxes: Boxes, **fields: Any) -> cpm.CollectivePerception:
    """Return the CPM of a car with known position and heading."""
    return cpm.CollectivePerception(
        7, 12.5, boxes, heading=0.3, latitude=48.1, longitude=11.5, altitude=500.0, **fields
    )


def alignment(arguments: argparse.Namespace) -> Table:
    """BEVGlue on lists that went through a message, and on those that did not."""
    print("## V2V4Real detections, the other car's list sent in different ways (means of the runs)\n")
    table: Table = []
    channels: dict[str, list[Channel]] = {
        "as it is": [lambda frame: (frame.other, frame.other_body)],
        "with jitter of 1 micrometre": [jitter(seed) for seed in range(RUNS)],
        "object message": [by_object_message],
        "CPM, heading known": [by_cpm(turn) for turn in np.arange(RUNS) * 0.7],
        "CPM, heading unknown": [by_cpm(None)],
        "SDSM, axes of the sender": [by_sdsm(None)],
        "SDSM, axes turned from the sender's": [by_sdsm(turn) for turn in np.arange(1, RUNS) * 0.7],
    }
    folder, cars = DATA / "v2v4real_detections", DATA / "v2v4real_cars.csv"
    for split, names in (("train", V2V4REAL_TRAIN), ("val", V2V4REAL_VAL)):
        if split not in arguments.splits:
            continue
        constant = v2v4real_sequences(folder, names, moving=False)
        own = v2v4real_car_sequences(folder, cars, names, bodies=True)
        for frames, sequences in (("constant frame", constant), ("own frames, with bodies", own)):
            for what, runs in channels.items():
                if arguments.channels not in what:
                    continue
                records = [run([sent(s, channel) for s in sequences], BEVGlue) for channel in runs]
                table.append({"what": f"{split}, {frames}, {what}", **spread(records)})
                print("   …", table[-1]["what"], file=sys.stderr)
    show(table)
    return table


def spread(runs: list[list[Record]]) -> dict[str, Any]:
    """Mean over the runs, and the range of the share that is right."""
    right = [summarise(records).right for records in runs]

    def mean_right(at_least: int) -> float:
        return float(np.mean([r.right for records in runs for r in records if r.co_visible >= at_least]))

    return {
        "runs": len(runs),
        "frames": len(runs[0]),
        "right": float(np.mean(right)),
        "lowest": min(right),
        "highest": max(right),
        "right >= 2": mean_right(2),
        "right >= 4": mean_right(4),
        "wrong of accepted": float(np.mean([summarise(records).wrong_of_accepted for records in runs])),
        "within 1 m, 1 degree": float(np.mean([summarise(records).success_1 for records in runs])),
    }


def jitter(seed: int) -> Channel:
    """Shift positions by 1 micrometre, to measure the sensitivity to negligible changes."""
    rng = np.random.default_rng([seed, 2])

    def channel(frame: PairFrame) -> Received:
        off = rng.normal(0.0, 1e-6, frame.other.center.shape)
        return frame.other.replace(center=frame.other.center + off), frame.other_body

    return channel


def by_object_message(frame: PairFrame) -> Received:
    """The other's list and body after they were sent as our own message."""
    message = decode(encode(ObjectMessage("7", 1.0, 0, frame.other, frame.other_body)))
    return message.boxes, message.body


def by_cpm(turn: float | None) -> Channel:
    """The other's list and body after they were sent as a CPM.

    Args:
        turn: of the ego's x axis from east [rad]; None if the sender does not know its heading.
    """

    def channel(frame: PairFrame) -> Received:
        boxes = frame.other.replace(score=None, label=None)
        body = None if frame.other_body is None else frame.other_body.replace(score=None, label=None)
        heading = None if turn is None else frame.ego_SE2_other.yaw + turn
        message = cpm.decode(cpm.encode(cpm.CollectivePerception(7, 1.0, boxes, body, heading=heading)))
        return message.boxes, message.body

    return channel


def by_sdsm(turn: float | None) -> Channel:
    """The other's list and body after they were sent as an SDSM.

    Args:
        turn: yaw of the sender's x axis from east [rad], the same in all frames; None if it is not known.
    """

    def channel(frame: PairFrame) -> Received:
        boxes = frame.other.replace(score=None, label=None)
        body = None if frame.other_body is None else frame.other_body.replace(score=None, label=None)
        if len(boxes) == 0 and body is None:
            return boxes, body  # an SDSM holds at least one object: none is sent
        message = sdsm.decode(sdsm.encode(sdsm.SensorDataSharing(7, 1.0, boxes, body, heading=turn)))
        if turn is None:
            return message.boxes, message.body
        own_SE2_axes = SE2(0.0, 0.0, -turn)  # back, as the truth is in the sender's frame
        turned = None if message.body is None else message.body.transform(own_SE2_axes)
        return message.boxes.transform(own_SE2_axes), turned

    return channel


def sent(sequence: AlignmentSequence, channel: Channel) -> AlignmentSequence:
    """The sequence with the other's lists as they arrive."""
    frames = []
    for frame in sequence.frames:
        other, body = channel(frame)
        frames.append(dataclasses.replace(frame, other=other, other_body=body))
    return AlignmentSequence(sequence.name, frames)


def draw(path: Path) -> None:
    """Draw bytes by number of boxes, and the position error after encoding and decoding."""
    counts = range(0, 61, 2)
    lists = [random_boxes(n) for n in counts]
    figure = new_figure(9.0, 3.6)
    volume, error = add_axes(figure, 1, 2)
    own = [len(encode(ObjectMessage("7", 12.5, 15, boxes))) for boxes in lists]
    small = [len(cpm.encode(perception(boxes, sensor_type=None))) for boxes in lists]
    full = [
        len(cpm.encode(perception(b, velocity=np.ones((len(b), 2)), age=np.ones(len(b)), position_std=np.ones(len(b)))))
        for b in lists
    ]
    volume.plot(counts, own, color=EGO, label="object message")
    volume.plot(counts, small, color=OTHER, label="CPM, boxes only")
    volume.plot(counts, full, color=OTHER, linestyle="--", label="CPM, also velocity, age, accuracy")
    volume.set(xlabel="boxes", ylabel="bytes")
    volume.legend(frameon=False, fontsize=8)
    boxes = random_boxes(250)
    gap = cpm.decode(cpm.encode(perception(boxes))).boxes.center - boxes.center
    error.hist(1e3 * np.hypot(gap[:, 0], gap[:, 1]), bins=20, color=MATCH)
    error.set(xlabel="horizontal distance from the position sent [mm]", ylabel="boxes of 250")
    for axes, title in ((volume, "Size of a message"), (error, "Rounding of positions in a CPM")):
        set_title(axes, title)
        light_grid(axes)
    save_figure(figure, path)


TABLES = {"bytes": sizes, "alignment": alignment}

if __name__ == "__main__":
    main()
