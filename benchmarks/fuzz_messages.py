"""Fuzz test of both message formats: decoding must not crash or return silently wrong boxes.

    python benchmarks/fuzz_messages.py                       # one minute
    python benchmarks/fuzz_messages.py --messages 10000000   # for an hour or two
    python benchmarks/fuzz_messages.py --only cpm --seed 7

Valid messages of all formats are damaged: flipped bits, other bytes, slices removed, doubled, or taken from another
message, cut off, special numbers. In half of the object messages the checksum is made right again afterwards, so that
the damage gets past it. Then:

- Decoding raises MessageError or returns; any other exception is a failure, and so is more than a second of
  processor time.
- An object message that decodes has a valid checksum and means what its bytes say, by a second, plain reading of them.
  If its checksum was not made right again, it is byte for byte a message that was sent.
- A CPM or SDSM has no checksum: a flipped bit may move a box. Its boxes are finite and within the standard's ranges,
  and encoding what was decoded and decoding that again gives the same boxes. With the node's session header, any that
  was changed is refused.
- A node goes through it all: it receives what decodes, and aligns.

Ctrl-C ends the format that is being tested, with a report so far. Exit code: 0 no failure, 1 failures, whose bytes are
printed.
"""

from __future__ import annotations

import argparse
import math
import signal
import struct
import sys
import time
import zlib
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from cobevglue import Boxes
from cobevglue.messages import MessageError, ObjectMessage, cpm, decode, encode, sdsm
from cobevglue.messages.cpm import CollectivePerception
from cobevglue.messages.sdsm import SensorDataSharing
from cobevglue.node import NodeCore, OwnList, SessionHeader, decode_header, encode_header
from cobevglue.typing import FloatArray
from common import print_head

FORMATS = ("object", "cpm", "sdsm")
SLOW = 1.0
"""A message may take so much processor time to decode [s]."""
NODE_EVERY, ALIGN_EVERY = 10, 100
"""A node gets one in so many messages, and aligns after so many of those."""
_SPECIAL: tuple[bytes, ...] = (
    b"\x00",
    b"\xff",
    b"\x7f",
    b"\x80",
    struct.pack("<f", math.nan),
    struct.pack("<f", math.inf),
)
_SPECIAL += tuple(struct.pack("<f", value) for value in (3.4e38, -1.0, -2.0, 1e-45, 16777216.0, 3.1415927))
_SPECIAL += tuple(struct.pack("<d", value) for value in (math.nan, -math.inf, 1e300, 1e11))
_IN_PLACE, _ALL = (0, 1, 7, 8), tuple(range(9))
"""Kinds of damage that keep the length, and all."""
_LIMITS = {"cpm": (255, math.sqrt(2.0) * 1310.71, 25.5), "sdsm": (256, 3276.71, 102.31)}
"""Most objects, largest coordinate and largest size [m] of the standards."""


@dataclass
class Report:
    """What happened to the messages of one format."""

    messages: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    accepted: int = 0
    unchanged: int = 0
    slowest: float = 0.0
    failures: list[str] = field(default_factory=list)

    def refuse(self, error: Exception) -> None:
        """Count a refusal by the first words of its reason."""
        self.refused[" ".join(str(error).replace(":", " ").split()[:3])[:40]] += 1

    def fail(self, what: str, data: bytes) -> None:
        """Keep a failure."""
        self.failures.append(f"{what}: {data.hex()}")


def main() -> None:
    """Fuzz until the time limit or the number of messages is reached."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="for all formats together")
    parser.add_argument("--messages", type=int, help="so many instead, the same number of each format")
    parser.add_argument("--only", choices=FORMATS)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print_head(f"seed {arguments.seed}")
    chosen = [arguments.only] if arguments.only else list(FORMATS)
    failed = False
    for name in chosen:
        started = time.monotonic()
        if arguments.messages is None:
            seconds, most = arguments.seconds / len(chosen), sys.maxsize
        else:
            seconds, most = math.inf, arguments.messages // len(chosen)
        report = fuzz(name, arguments.seed, most, seconds)
        show(name, report, time.monotonic() - started)
        failed |= bool(report.failures)
    sys.exit(failed)


def fuzz(name: str, seed: int, messages: int, seconds: float = math.inf) -> Report:
    """Damage and check messages of one format.

    Args:
        name: of the format, in `FORMATS`.
        seed: of the random numbers.
        messages: how many at most; rounded up to hundreds.
        seconds: for how long at most [s].
    """
    stream = FORMATS.index(name)
    originals = {"object": object_messages, "cpm": cpms, "sdsm": sdsms}[name](seed)
    check = check_object_message if name == "object" else partial(check_standard_message, name)
    known = frozenset(originals)
    report, node = Report(), Node()
    batch, end = 0, time.monotonic() + seconds
    interrupted: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: interrupted.append(number))
    while report.messages < messages and time.monotonic() < end and not interrupted:
        rng = np.random.default_rng([seed, stream, batch])
        batch += 1
        for _ in range(100):
            original = originals[rng.integers(len(originals))]
            repaired = name == "object" and rng.random() < 0.5
            data = damaged(original, originals, rng, _IN_PLACE if repaired else _ALL)
            if repaired:
                data = data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))
            report.messages += 1
            report.unchanged += data in known
            started = time.thread_time()
            check(data, known, repaired, report)
            report.slowest = max(report.slowest, time.thread_time() - started)
            if name != "object":
                check_header(original, data, report)
            if report.messages % NODE_EVERY == 0:
                node.take(data, report)
        if report.slowest > SLOW:
            report.fail(f"slow: {report.slowest:.1f} s", data)
            break
    signal.signal(signal.SIGINT, before)
    return report


def show(name: str, report: Report, seconds: float) -> None:
    """Print a report."""
    changed = report.accepted - report.unchanged
    print(f"## {name}: {report.messages:,} messages in {seconds:.0f} s, {len(report.failures)} failures\n")
    print(f"decoded: {report.accepted:,}, of which damaged: {max(changed, 0):,}; slowest check {report.slowest:.3f} s")
    print("refused: " + ", ".join(f"{count:,} {reason}" for reason, count in report.refused.most_common(12)))
    for failure in report.failures[:20]:
        print(f"FAILED {failure}")
    print(flush=True)


def damaged(data: bytes, others: list[bytes], rng: np.random.Generator, kinds: tuple[int, ...]) -> bytes:
    """The message after one to four random damages of these kinds."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        kind, size = kinds[rng.integers(len(kinds))], len(changed)
        at = int(rng.integers(size)) if size else 0
        length = int(rng.integers(1, 33))
        if kind == 0 and size:
            changed[at] ^= 1 << int(rng.integers(8))
        elif kind == 1 and size:
            changed[at] = int(rng.integers(256))
        elif kind == 2:
            del changed[at : at + length]
        elif kind == 3:
            changed[at:at] = changed[at : at + length]
        elif kind == 4:
            changed[at:at] = rng.bytes(length)
        elif kind == 5:
            other = others[rng.integers(len(others))]
            changed[at:] = other[at:]
        elif kind == 6:
            del changed[at:]
        elif kind == 7:
            special = _SPECIAL[rng.integers(len(_SPECIAL))]
            changed[at : at + len(special)] = special[: size - at]
        else:  # in the header, where counts and versions are
            changed[at % 44 : at % 44 + 1] = _SPECIAL[rng.integers(4)][: size - at % 44]
    return bytes(changed)


def check_object_message(data: bytes, known: frozenset[bytes], repaired: bool, report: Report) -> None:
    """Check that an object message is rejected, or has a valid checksum and is decoded correctly."""
    try:
        message = decode(data)
    except MessageError as error:
        report.refuse(error)
        return
    except Exception as error:  # any other exception is a failure
        report.fail(f"{type(error).__name__}: {error}", data)
        return
    report.accepted += 1
    if zlib.crc32(data[:-4]) != struct.unpack("<I", data[-4:])[0]:
        report.fail("accepted with a wrong checksum", data)
    if not repaired and data not in known:
        report.fail("accepted although it is no message that was sent (a checksum by chance?)", data)
    if not np.array_equal(rows_of(message), rows_in(data), equal_nan=True):
        report.fail("not what the bytes say", data)
    if not plausible(message.boxes, math.inf, math.inf):
        report.fail("invalid boxes", data)


def check_standard_message(name: str, data: bytes, _known: frozenset[bytes], _repaired: bool, report: Report) -> None:
    """A CPM or SDSM is refused, or its boxes are within the standard's ranges and survive another round."""
    standard: Any = {"cpm": cpm, "sdsm": sdsm}[name]
    most, farthest, largest = _LIMITS[name]
    try:
        message = standard.decode(data)
    except MessageError as error:
        report.refuse(error)
        return
    except Exception as error:
        report.fail(f"{type(error).__name__}: {error}", data)
        return
    report.accepted += 1
    if len(message.boxes) > most or not plausible(message.boxes, farthest, largest):
        report.fail("boxes beyond the standard's ranges", data)
    if len(message.boxes) == 0 or message.boxes.track_id is not None:
        try:  # an SDSM of which no object is a box cannot be sent again
            again = standard.decode(standard.encode(message))
        except MessageError as error:
            report.refuse(error)
            return
        if not np.allclose(again.boxes.center, message.boxes.center, atol=1e-6, rtol=0.0):
            report.fail("other boxes after another round", data)


def check_header(original: bytes, data: bytes, report: Report) -> None:
    """Check that the session header of the original message rejects any other message."""
    header = encode_header(SessionHeader(1, 1), original)
    try:
        decode_header(header, data)
    except MessageError:
        return
    if data != original:
        report.fail("accepted with the session header of another message", data)


class Node:
    """A node that receives damaged messages and goes on aligning."""

    def __init__(self) -> None:
        self.core = NodeCore("fuzzed", 1)
        self.now, self.taken = 0.0, 0
        rng = np.random.default_rng([0, 99])
        center = np.column_stack([rng.uniform(-40.0, 40.0, (8, 2)), np.zeros(8)])
        self.boxes = Boxes(center, np.tile([4.5, 1.9, 1.5], (8, 1)), rng.uniform(-3.0, 3.0, 8))

    def take(self, data: bytes, report: Report) -> None:
        """Give it a message, sometimes with a session header."""
        self.now += 0.001
        self.taken += 1
        header = encode_header(SessionHeader(self.taken % 3 + 1, self.taken), data) if self.taken % 2 else None
        try:
            self.core.receive(data, self.now, header)
            if self.taken % ALIGN_EVERY == 0:
                self.core.observe(OwnList(self.boxes, self.now), self.now)
                self.core.align(self.now)
        except Exception as error:
            report.fail(f"node: {type(error).__name__}: {error}", data)


def rows_of(message: ObjectMessage) -> FloatArray:
    """(N, 7) x, y, z, l, w, h, yaw of the boxes, and of the own vehicle as the last row."""
    boxes = message.boxes
    rows = np.column_stack([boxes.center, boxes.size, boxes.yaw])
    if message.body is None:
        return rows
    return np.vstack([rows, np.column_stack([message.body.center, message.body.size, message.body.yaw])])


def rows_in(data: bytes) -> FloatArray:
    """The same, read from the bytes one number after the other as the layout's table says."""
    version, id_length, count = struct.unpack_from("<BBH", data, 4)
    offset = 20
    origin_x, origin_y = 0.0, 0.0
    if version == 2:
        origin_x, origin_y = struct.unpack_from("<dd", data, offset)
        offset += 16
    offset += id_length
    rows = []
    for _ in range(count):
        x, y, z, length, width, height, yaw, _id = struct.unpack_from("<8f", data, offset)
        rows.append((x + origin_x, y + origin_y, z, length, width, height, yaw))
        offset += 32
    return np.array(rows).reshape(-1, 7)


def plausible(boxes: Boxes, farthest: float, largest: float) -> bool:
    """Whether the boxes are finite and within these limits [m]."""
    return bool(
        np.isfinite(boxes.center).all()
        and np.isfinite(boxes.yaw).all()
        and (np.abs(boxes.center) <= farthest).all()
        and (boxes.size[:, :2] > 0.0).all()
        and (boxes.size >= 0.0).all()
        and (boxes.size <= largest).all()
    )


def random_boxes(rng: np.random.Generator, n: int, ids: bool) -> Boxes:
    """Cars within 80 m."""
    return Boxes(
        rng.uniform(-80.0, 80.0, (n, 3)) * [1.0, 1.0, 0.02],
        [4.5, 1.9, 1.6] + rng.uniform(-0.3, 0.3, (n, 3)),
        rng.uniform(-math.pi, math.pi, n),
        track_id=np.arange(n) if ids else None,
    )


def object_messages(seed: int) -> list[bytes]:
    """Valid object messages of many kinds."""
    messages = []
    for index, n in enumerate((0, 1, 2, 3, 8, 8, 20)):
        rng = np.random.default_rng([seed, 10, index])
        body = Boxes([[0.0, 0.0, 0.0]], [[4.5, 1.9, 1.5]], [0.0]) if index % 2 else None
        agent = ("a", "car2", "Straße-7")[index % 3]
        messages.append(encode(ObjectMessage(agent, 1e9 + index, index, random_boxes(rng, n, index % 4 > 0), body)))
    first = messages[3]  # version 1: without the origin
    old = first[:4] + b"\x01" + first[5:20] + first[36:-4]
    return [*messages, old + struct.pack("<I", zlib.crc32(old))]


def cpms(seed: int) -> list[bytes]:
    """Valid CPMs of many kinds."""
    messages = []
    for index, n in enumerate((0, 1, 2, 3, 6)):
        rng = np.random.default_rng([seed, 11, index])
        boxes = random_boxes(rng, n, True).replace(label=np.full(n, "car"), score=rng.uniform(0.0, 1.0, n))
        more: dict[str, Any] = {"velocity": rng.normal(0.0, 10.0, (n, 2)), "age": np.full(n, 1.0)} if index % 2 else {}
        accuracy: dict[str, Any] = {"position_std": np.full(n, 0.2), "yaw_std": np.full(n, 0.02)} if index % 3 else {}
        heading = (None, 0.5, -2.0)[index % 3]
        roadside: dict[str, Any] = {"is_infrastructure": True} if index == 4 else {}
        messages.append(
            cpm.encode(CollectivePerception(7 + index, 7e8, boxes, heading=heading, **more, **accuracy, **roadside))
        )
    return messages


def sdsms(seed: int) -> list[bytes]:
    """Valid SDSMs of many kinds."""
    messages = []
    for index, n in enumerate((1, 2, 3, 6)):
        rng = np.random.default_rng([seed, 12, index])
        labels = np.array(["car", "pedestrian", "animal"])[np.arange(n) % 3]
        boxes = random_boxes(rng, n, True).replace(label=labels, score=rng.uniform(0.0, 1.0, n))
        more: dict[str, Any] = {"velocity": rng.normal(0.0, 10.0, (n, 2))} if index % 2 else {}
        place: dict[str, Any] = {"latitude": 48.0, "longitude": -83.0, "heading": 0.5} if index > 1 else {}
        body = Boxes([[0.0, 0.0, 0.0]], [[4.5, 1.9, 1.5]], [0.0]) if index == 3 else None
        messages.append(sdsm.encode(SensorDataSharing(7 + index, 1.7e9, boxes, body, **more, **place)))
    return messages


if __name__ == "__main__":
    main()
