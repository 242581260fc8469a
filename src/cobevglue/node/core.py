"""A live agent without its network: own lists and received bytes in, messages, alignments and fused objects out.

    core = NodeCore("car1", new_session())
    sent = core.observe(own_list, now)          # to be sent to the others
    core.receive(data, now, header)             # for each message that arrives, in any order
    result = core.align(now)                    # after each own list

No threads, no clock and no input or output: `now` is a time on any clock that never goes back. Messages that are
late, doubled, reordered, corrupted or of a newer version are refused with a reason and counted; what is kept is
bounded.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from cobevglue.alignment import Alignment, group_aligner
from cobevglue.boxes import Boxes
from cobevglue.messages import MAX_TRACK_ID, VERSION, MessageError, ObjectMessage, decode, encode
from cobevglue.node.metrics import Metrics
from cobevglue.node.own_list import OwnList
from cobevglue.node.sender import SAME_INSTANT, Sender
from cobevglue.node.session_header import MAX_SEQUENCE, SessionHeader, UnknownVersionError, decode_header, encode_header
from cobevglue.object_collaboration import ObjectCollaboration
from cobevglue.settings import Settings
from cobevglue.tracking import Sort

__all__ = ["NodeCore", "NodeResult", "NodeSettings", "Outgoing", "Refused", "warm_up"]

Refused = Literal[
    "",
    "corrupted",
    "newer version",
    "implausible",
    "echo",
    "own id",
    "duplicate",
    "out of order",
    "late",
    "old session",
    "second agent",
    "other clock",
    "too many agents",
    "no CPM decoder",
]
"""Why a message is not used: labels of the metrics; "" if it is."""

_LATEST = 1e11  # time stamps from here on are not in seconds [s]
_OWN_CLOCK_SET = 1.0  # an own list so much older than the last one is no straggler [s]
_FARTHEST, _LARGEST = 1e8, 100.0  # of a frame's origin, of an object's size [m]
_MAX_SENDERS = 1024  # of which the last number is remembered
_MAX_EVENTS = 100
# How the formats begin: a CPM by its version and its message id, an SDSM by the id in its frame.
_COMPACT, _CPM, _SDSM = b"CBVG", b"\x02\x0e", b"\x00\x29"

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_Count = Annotated[int, Field(ge=1)]


class NodeSettings(Settings):
    """Settings of a node.

    Attributes:
        max_age: lists that arrived longer ago, or were so much longer on their way than the agent's fastest, are not
            aligned with [s].
        forget: an agent that was silent for so long is forgotten [s].
        takeover: a restarted agent replaces its earlier session after so long a silence of that [s].
        clock_tolerance: for agents with synchronised clocks: time stamps that differ more from the own are refused [s].
        max_agents: others that are followed at a time.
        max_objects: of a list.
        max_extent: objects are within this distance of the middle of their list [m].
        aligner: name of the aligner: "bevglue" or, for few agents, "bevglue-group".
    """

    max_age: _Positive = 0.5
    forget: _Positive = 5.0
    takeover: _Positive = 0.5
    clock_tolerance: _Positive | None = None
    max_agents: _Count = 32
    max_objects: _Count = 256
    max_extent: _Positive = 2000.0
    aligner: Literal["bevglue", "bevglue-group"] = "bevglue"


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A message to send, and the header to send beside it."""

    data: bytes
    header: bytes


@dataclass(frozen=True, slots=True, eq=False)
class NodeResult:
    """What the agent knows after one of its lists.

    Attributes:
        time: time stamp of the own list [s].
        alignments: of every other agent that is present; a refusal for one whose last message is too old.
        objects: objects of all agents in the own frame at that time, sorted by score.
    """

    time: float
    alignments: dict[str, Alignment]
    objects: Boxes


@dataclass(slots=True, eq=False)
class _Present:
    """Another agent that is present: its newest list."""

    message: ObjectMessage
    arrival: float


class NodeCore:
    """One agent among others.

    Args:
        agent: its id, as in an `ObjectMessage`.
        session: a number that grows with every start: `new_session()`.
        settings: of the node.
        body: one-row box of the own vehicle in its own frame, for own lists that come without one; or None.

    Raises:
        MessageError: the id is not printable or too long, or `body` has not one row.

    Attributes:
        metrics: what happened so far.
        events: lines to show to the user, newest last; take them out. The oldest are dropped.
        verdicts: of the last alignment, by agent: "accepted" or "refused".
    """

    def __init__(
        self, agent: str, session: int, settings: NodeSettings | None = None, body: Boxes | None = None
    ) -> None:
        ObjectMessage(agent, 0.0, 0, Boxes.empty(), body)  # raises MessageError if these cannot be sent
        self._body = body
        self.agent, self.session = agent, session
        self.settings = settings or NodeSettings()
        self.metrics = Metrics()
        self.events: deque[str] = deque(maxlen=_MAX_EVENTS)
        self.verdicts: dict[str, str] = {}
        self._collaboration = ObjectCollaboration(group_aligner(self.settings.aligner))
        self._tracker = Sort()
        self._sequence = 0
        self._own: OwnList | None = None
        self._own_arrival = -math.inf
        self._interval: float | None = None
        self._senders: dict[str, Sender] = {}
        self._present: dict[str, _Present] = {}
        self._reported: set[tuple[str, str]] = set()

    def observe(self, own: OwnList, now: float) -> Outgoing:
        """Take the next own list; returns the message to send.

        Raises:
            ValueError: the list cannot be used: its time stamp is not later than the last one's, it has too many
                objects or implausible ones. The node goes on as if it had not been given.
        """
        if not math.isfinite(own.time) or abs(own.time) >= _LATEST:
            raise ValueError(f"object list: time must be in seconds, got {own.time:.6g}")
        problem = self._implausible(own.boxes) or self._implausible(own.body)
        if problem:
            raise ValueError(f"object list: {problem}")
        if self._own is not None and own.time < self._own.time + SAME_INSTANT:
            if own.time > self._own.time - _OWN_CLOCK_SET:
                raise ValueError(f"object list: time {own.time} s is not later than the last one's, {self._own.time} s")
            self._start_anew(own.time)
        tracked, body = self._tracked(own), self._body if own.body is None else own.body
        message = encode(ObjectMessage(self.agent, own.time, self._sequence, tracked, body))
        header = encode_header(SessionHeader(self.session, self._sequence), message)
        self._sequence = (self._sequence + 1) % (MAX_SEQUENCE + 1)
        self._own = OwnList(tracked, own.time, body)
        self._note_arrival(now)
        self.metrics.count("lists_total")
        self.metrics.count("sent_bytes_total", len(message) + len(header))
        return Outgoing(message, header)

    def receive(self, data: bytes, now: float, header: bytes | None = None) -> Refused:
        """Take a message that arrived.

        Args:
            data: an object message, a CPM or an SDSM.
            now: when it arrived [s].
            header: the session header beside it; None if there was none.

        Returns:
            "" if it is used from the next alignment on, otherwise why it is not.
        """
        self.metrics.count("received_bytes_total", len(data) + len(header or b""))
        refused, detail = self._take(data, now, header)
        if refused:
            self.metrics.count("refused_total", reason=refused)
            if detail and refused in ("newer version", "own id", "no CPM decoder", "too many agents"):
                self._report_once(refused, "", detail)
        return refused

    def align(self, now: float) -> NodeResult | None:
        """Align the last own list with the newest lists of the others; None before the first own list."""
        self.forget_silent(now)
        own = self._own
        if own is None:
            return None
        fresh = {name: other for name, other in self._present.items() if now - other.arrival <= self.settings.max_age}
        bodies = {name: other.message.body for name, other in fresh.items()} | {self.agent: own.body}
        seen = self._collaboration.step(
            {self.agent: own.boxes} | {name: other.message.boxes for name, other in fresh.items()},
            self.agent,
            own.time,
            {name: other.message.time for name, other in fresh.items()},
            {name: body for name, body in bodies.items() if body is not None},
        )
        alignments = {
            name: seen.alignments[name]
            if name in fresh
            else Alignment.refused(f"no new list for {now - other.arrival:.1f} s")
            for name, other in self._present.items()
        }
        self._note_alignments(alignments, len(seen.objects), now)
        return NodeResult(own.time, alignments, seen.objects)

    def forget_silent(self, now: float) -> None:
        """Forget the agents that have been silent for too long; `align` does it, too."""
        for agent, other in list(self._present.items()):
            if now - other.arrival > self.settings.forget:
                del self._present[agent]
                self._collaboration.forget(agent)
                self.metrics.drop_agent(agent)
                self._reported = {entry for entry in self._reported if entry[1] != agent}
                self.metrics.count("forgotten_total")
                self.events.append(f"{agent}: silent for {now - other.arrival:.1f} s, forgotten")

    def _take(self, data: bytes, now: float, header_bytes: bytes | None) -> tuple[Refused, str]:
        """Decode a message and judge it; the reason of refusal and, for the user, a line of detail."""
        try:
            header = None if header_bytes is None else decode_header(header_bytes, data)
            message = _decode(data)
        except UnknownVersionError as error:
            return "newer version", str(error)
        except MessageError as error:
            return "corrupted", str(error)
        except ModuleNotFoundError as error:
            return "no CPM decoder", str(error)
        agent = message.agent_id
        if agent == self.agent:
            if header is not None and header.session == self.session:
                return "echo", ""
            return "own id", f"another agent sends as {agent}, too: its messages are not used"
        if abs(message.time) >= _LATEST or self._implausible(message.boxes) or self._implausible(message.body):
            return "implausible", ""
        tolerance = self.settings.clock_tolerance
        if tolerance is not None and self._own is not None:
            own_time = self._own.time + now - self._own_arrival
            if abs(message.time - own_time) > tolerance:
                return "other clock", ""
        if agent not in self._present and len(self._present) >= self.settings.max_agents:
            return "too many agents", f"more than {self.settings.max_agents} agents: {agent} is not followed"
        refused = self._admit(agent, header, message.time, now)
        if not refused:
            if agent not in self._present:
                self.events.append(f"{agent}: here")
            self._present[agent] = _Present(message, now)
        if agent in self._present:
            self.metrics.count("received_total", agent=agent)
        return refused, ""

    def _admit(self, agent: str, header: SessionHeader | None, time: float, now: float) -> Refused:
        """Whether the message of this agent is newer than what came before."""
        sender = self._senders.pop(agent, None)
        if sender is None:
            self._senders[agent] = Sender(header, time, now)
            if len(self._senders) > _MAX_SENDERS:  # in the order in which they were last heard
                del self._senders[next(iter(self._senders))]
            return ""
        self._senders[agent] = sender
        admission = sender.admit(header, time, now, self.settings.max_age, self.settings.takeover)
        if admission.starts_anew:
            self._collaboration.forget(agent)
            self.metrics.count("restarts_total")
            self.events.append(f"{agent}: {admission.starts_anew}")
        return admission.refused

    def _tracked(self, own: OwnList) -> Boxes:
        """The own boxes with track ids that can be sent."""
        boxes = own.boxes
        if boxes.track_id is not None:
            ids = boxes.track_id % (MAX_TRACK_ID + 1)
            if len(np.unique(ids)) == len(ids):
                return boxes.replace(track_id=ids)
        tracked = self._tracker.update(boxes.replace(track_id=None), own.time)
        assert tracked.track_id is not None
        return tracked.replace(track_id=tracked.track_id % (MAX_TRACK_ID + 1))

    def _start_anew(self, time: float) -> None:
        assert self._own is not None
        self.events.append(f"own lists: time goes back from {self._own.time} s to {time} s, everything is forgotten")
        self._collaboration.reset()
        self._tracker = Sort()
        self._own = None

    def _implausible(self, boxes: Boxes | None) -> str:
        """What is wrong with these boxes, "" if nothing: numbers that are valid, and that no sensor measures."""
        if boxes is None or not len(boxes):
            return ""
        if len(boxes) > self.settings.max_objects:
            return f"boxes: {len(boxes)} objects, at most {self.settings.max_objects} are used"
        extent = np.abs(boxes.center - np.median(boxes.center, axis=0)).max(axis=1)
        wrong = (
            (extent > self.settings.max_extent)
            | (np.abs(boxes.center) > _FARTHEST).any(axis=1)
            | (boxes.size > _LARGEST).any(axis=1)
        )
        if not wrong.any():
            return ""
        row = int(wrong.argmax())
        return f"boxes: row {row} is implausible: center {boxes.center[row].tolist()}, size {boxes.size[row].tolist()}"

    def _note_arrival(self, now: float) -> None:
        if self._own_arrival > -math.inf:
            step = now - self._own_arrival
            self._interval = step if self._interval is None else 0.9 * self._interval + 0.1 * step
            self.metrics.set("list_rate_hertz", 1.0 / self._interval if self._interval > 0.0 else math.inf)
        self._own_arrival = now

    def _note_alignments(self, alignments: dict[str, Alignment], n_objects: int, now: float) -> None:
        self.metrics.set("agents", len(alignments))
        self.metrics.set("objects", n_objects)
        self.verdicts = {name: "accepted" if found.accepted else "refused" for name, found in alignments.items()}
        for agent, alignment in alignments.items():
            self.metrics.count("alignments_total", agent=agent, verdict=self.verdicts[agent])
            self.metrics.set("alignment_risk", alignment.risk, agent=agent)
            if alignment.accepted:
                self.metrics.set("time_offset_seconds", alignment.time_offset, agent=agent)
            sender = self._senders[agent]
            self.metrics.set("lost_messages", sender.lost, agent=agent)
            two = sender.two_agents(now)
            self.metrics.set("two_agents", float(two), agent=agent)
            if two:
                self._report_once("two agents", agent, f"{agent}: two agents send under this id; the first one is used")

    def _report_once(self, kind: str, what: str, line: str) -> None:
        if (kind, what) not in self._reported and len(self._reported) < _MAX_EVENTS:
            self._reported.add((kind, what))
            self.events.append(line)


def warm_up() -> None:
    """Load the compiled kernels, or compile them, which takes some 20 s once: before an agent joins the others."""
    first, second = NodeCore("first", 1), NodeCore("second", 2)
    center = np.array([[5.0, 3.0, 0.0], [17.0, -4.0, 0.0], [-9.0, 6.0, 0.0], [30.0, 2.0, 0.0]])
    boxes = Boxes(center, np.tile([4.5, 1.9, 1.5], (4, 1)), np.zeros(4))
    body = Boxes([[0.0, 0.0, 0.0]], [[4.5, 1.9, 1.5]], [0.0])
    for step in range(3):
        now = 0.1 * step
        sent = second.observe(OwnList(boxes, now, body), now)
        first.receive(sent.data, now, sent.header)
        first.observe(OwnList(boxes, now, body), now)
        first.align(now)


def _decode(data: bytes) -> ObjectMessage:
    """The object message, or the CPM or SDSM as one.

    Raises:
        UnknownVersionError: an object message of a newer version.
        MessageError: none of them.
        ModuleNotFoundError: a CPM or SDSM, and its decoder is not installed.
    """
    if data[: len(_CPM)] == _CPM:
        from cobevglue.messages import cpm

        return cpm.decode(data).object_message()
    if data[: len(_SDSM)] == _SDSM:
        from cobevglue.messages import sdsm

        return sdsm.decode(data).object_message()
    if data[: len(_COMPACT)] == _COMPACT and len(data) > len(_COMPACT) and data[len(_COMPACT)] > VERSION:
        raise UnknownVersionError(
            f"object message of version {data[len(_COMPACT)]}, versions up to {VERSION} can be read"
        )
    return decode(data)
