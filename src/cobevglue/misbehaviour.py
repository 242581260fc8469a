"""Misbehaviour detection: does another agent's list contradict what the ego sees in plain view?

    detector = MisbehaviourDetector()          # one per collaborator
    report = detector.update(ego_boxes, other_boxes, alignment, time)
    if report.misbehaving: ...                 # send report.as_dict()
    if report.exclude: ...                     # leave this agent out of fusion

Plain view is within `max_range` of the observer and not hidden behind boxes that both sides can check. Every object
counts once, whatever the number of frames, as what one detector does not see it does not see for long. Of N objects
that the other reports in the ego's plain view, each is missing from the ego's list with a probability that honest
detectors have, too; if a share of them were invented, more would be missing. The log-likelihood ratio of the two,
with the most likely share, is the test (a generalised likelihood ratio); the same for the ego's objects in plain view
of the other that the other does not report. A list that was sent before is a replay.

The words are those of ETSI TS 103 759: an *observation* of a detector, of class 2 (against earlier messages of the same
station) or 4 (against on-board sensors), and a *misbehaviour report* of observations and evidence. Its published
observations are of CAM and DENM. Those here are of object lists and have names of our own.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from cobevglue.alignment.alignment import Alignment
from cobevglue.boxes import Boxes
from cobevglue.clock import Clock
from cobevglue.se2 import SE2
from cobevglue.settings import Settings
from cobevglue.simulation.visibility import visible_fraction
from cobevglue.typing import BoolArray, FloatArray

__all__ = ["MisbehaviourConfig", "MisbehaviourDetector", "MisbehaviourReport", "Observation"]

ObservationName = Literal[
    "PerceivedObject-NotSeen", "PerceivedObject-Missing", "PerceivedObject-Displaced", "ObjectList-Replayed"
]

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_Probability = Annotated[float, Field(gt=0.0, lt=1.0)]

_FRAME = 0.1
"""Time between frames when none is given [s]."""
_SHARES = np.arange(1, 20) / 20.0
"""Shares of invented (removed) objects that are tried."""


class MisbehaviourConfig(Settings):
    """Settings of `MisbehaviourDetector`; how they were chosen: docs/trust.md.

    Attributes:
        max_range: of plain view [m].
        min_range: nearer is the observer itself [m].
        visible: least share of a box's width that nothing hides.
        distance: boxes within this are one object [m].
        missing_near: probability that an honest detector does not see an object in plain view, up to 20 m.
        missing_per_m: what it grows by for each metre beyond.
        frames: objects count once they were in plain view so often.
        contradicted: and are missing if they were missing in this share of the frames.
        memory: objects count until they were out of view so long [s].
        evidence: threshold of the log-likelihood ratio for reporting misbehaviour [nats].
        exclusion: threshold for excluding the agent from fusion [nats].
        objects: and at least so many missing objects.
        displaced: an invented object has a removed one within this, and is a displaced one [m].
        repeats: lists sent before, in `history`, that make a replay.
        history: how many lists are remembered.
        risk: alignments of a higher stated risk are not used.
        margin: nor those of which the margin is a smaller share of the evidence.
    """

    max_range: _Positive = 40.0
    min_range: _Positive = 4.0
    visible: _Probability = 0.7
    distance: _Positive = 3.0
    missing_near: _Probability = 0.2
    missing_per_m: Annotated[float, Field(ge=0.0, le=0.1)] = 0.01
    frames: Annotated[int, Field(ge=1)] = 5
    contradicted: _Probability = 0.8
    memory: _Positive = 5.0
    evidence: _Positive = 5.5
    exclusion: _Positive = 10.0
    objects: Annotated[int, Field(ge=1)] = 3
    displaced: _Positive = 8.0
    repeats: Annotated[int, Field(ge=1)] = 3
    history: Annotated[int, Field(ge=1)] = 600
    risk: Annotated[float, Field(gt=0.0, le=1.0)] = 0.01
    margin: Annotated[float, Field(ge=0.0, le=1.0)] = 0.55


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What a detector found wrong (TS 103 759: an observation).

    Attributes:
        name: of the observation.
        detection_class: 2, against earlier messages of the station, or 4, against on-board sensors.
        evidence: log-likelihood ratio [nats]; infinite for a replay.
        track_ids: of the objects: the other's, for "PerceivedObject-Missing" the ego's.
        share: most likely share of objects that are invented or removed; 1 for a replay.
    """

    name: ObservationName
    detection_class: Literal[2, 4]
    evidence: float
    track_ids: tuple[int, ...]
    share: float


@dataclass(frozen=True, slots=True, eq=False)
class MisbehaviourReport:
    """The state of one agent's case in one frame.

    Attributes:
        time: of the frame [s].
        observations: what speaks against the agent; none in a report on an agent without misbehaviour.
        invented: evidence for invented objects so far [nats].
        removed: evidence for removed objects so far [nats].
        exclude: whether the agent should be excluded from fusion.
        tested: number of the other's objects in the ego's plain view, and of the ego's in the other's.
    """

    time: float
    observations: tuple[Observation, ...]
    invented: float
    removed: float
    tested: tuple[int, int]
    exclude: bool

    @property
    def misbehaving(self) -> bool:
        """Whether the report has observations."""
        return bool(self.observations)

    def as_dict(self, agent: str) -> dict[str, Any]:
        """For JSON: observations and evidence under names of TS 103 759.

        The messages themselves, signed, are to be added by the station as `v2xPduEvidence`.
        """
        return {
            "generationTime": self.time,
            "subject": agent,
            "observations": [
                {"observation": o.name, "detectionClass": o.detection_class, "trackIds": list(o.track_ids)}
                for o in self.observations
            ],
            "nonV2xPduEvidence": [
                {"logLikelihoodRatio": None if np.isinf(o.evidence) else o.evidence, "share": o.share}
                for o in self.observations
            ],
        }


@dataclass(slots=True)
class _Object:
    """Number of frames with an object in plain view of the other agent, and of those without a report of it."""

    last: float
    seen: int = 0
    missing: int = 0
    probability: float = 0.0
    near_removed: int = 0


class MisbehaviourDetector:
    """Tests the lists of one other agent against the ego's. Use one for each collaborator."""

    def __init__(self, config: MisbehaviourConfig | None = None) -> None:
        """Start with nothing seen."""
        self.config = config or MisbehaviourConfig()
        self._clock = Clock(_FRAME)
        self._theirs: dict[int, _Object] = {}
        self._mine: dict[int, _Object] = {}
        self._lists: OrderedDict[bytes, None] = OrderedDict()
        self._repeats = 0

    def update(self, ego: Boxes, other: Boxes, alignment: Alignment, time: float | None = None) -> MisbehaviourReport:
        """The next frame. Without an unambiguous alignment, only a replay can be found.

        Args:
            ego: tracked boxes in the ego frame.
            other: tracked boxes in the other's frame, as received.
            alignment: of the two lists.
            time: of the frame [s]; 0.1 s after the last by default.

        Raises:
            ValueError: boxes without track ids, or `time` is not later than the last.
        """
        for name, boxes in (("ego", ego), ("other", other)):
            if boxes.track_id is None and len(boxes):
                raise ValueError(f"{name}: boxes have no track ids, which evidence is gathered by")
        self._clock.advance(time)
        assert self._clock.time is not None
        now = self._clock.time
        self._check_replay(other)
        config = self.config
        clear = not (alignment.risk > config.risk or alignment.margin < config.margin * alignment.evidence)
        if alignment.ego_SE2_other is not None and clear and len(ego) and len(other):
            received = alignment.boxes_at_ego_instant(other)
            self._compare(ego, received, alignment.ego_SE2_other, now)
        for objects in (self._theirs, self._mine):
            for key in [key for key, o in objects.items() if now - o.last > config.memory]:
                del objects[key]
        return self._report(now)

    def reset(self) -> None:
        """Forget all frames."""
        self._clock.reset()
        self._theirs.clear()
        self._mine.clear()
        self._lists.clear()
        self._repeats = 0

    def _check_replay(self, other: Boxes) -> None:
        """Two measurements are never equal to the last bit; a list that repeats an earlier one is no measurement."""
        if not len(other):
            return
        digest = hashlib.sha256(np.round(other.bev, 6).tobytes()).digest()
        self._repeats = self._repeats + 1 if digest in self._lists else 0
        self._lists[digest] = None
        while len(self._lists) > self.config.history:
            self._lists.popitem(last=False)

    def _compare(self, ego: Boxes, received: Boxes, ego_SE2_other: SE2, now: float) -> None:
        gap = np.linalg.norm(ego.center[:, None, :2] - received.center[None, :, :2], axis=-1)
        theirs_missing = gap.min(axis=0) > self.config.distance
        mine_missing = gap.min(axis=1) > self.config.distance
        near = (gap[mine_missing] < self.config.displaced).any(axis=0)
        self._gather(self._theirs, received, [ego], theirs_missing, near, now)
        other_SE2_ego = ego_SE2_other.inverse()
        mine, theirs = ego.transform(other_SE2_ego), received.transform(other_SE2_ego)
        self._gather(self._mine, mine, [mine, theirs], mine_missing, np.zeros(len(mine), np.bool_), now)

    def _gather(
        self,
        objects: dict[int, _Object],
        boxes: Boxes,
        occluders: list[Boxes],
        missing: BoolArray,
        near: BoolArray,
        now: float,
    ) -> None:
        """Count the boxes in plain view of an observer at the origin."""
        config = self.config
        distance = np.hypot(boxes.center[:, 0], boxes.center[:, 1])
        track_id = boxes.track_id
        assert track_id is not None
        for row in np.flatnonzero((distance > config.min_range) & (distance < config.max_range)):
            if not self._in_plain_view(boxes[[row]], occluders):
                continue
            found = objects.setdefault(int(track_id[row]), _Object(now))
            found.last = now
            found.seen += 1
            found.missing += bool(missing[row])
            found.near_removed += bool(missing[row] and near[row])
            found.probability = config.missing_near + config.missing_per_m * max(float(distance[row]) - 20.0, 0.0)

    def _in_plain_view(self, box: Boxes, occluders: list[Boxes]) -> bool:
        """Whether little of a box is hidden by the others; boxes at its own place are taken for itself."""
        parts = [_geometry(box)]
        for others in occluders:
            away = np.linalg.norm(others.center[:, :2] - box.center[0, :2], axis=-1) > self.config.distance
            away &= np.hypot(others.center[:, 0], others.center[:, 1]) > self.config.min_range
            parts.append(_geometry(others[away]))
        return bool(visible_fraction(Boxes.concatenate(parts))[0] >= self.config.visible)

    def _report(self, now: float) -> MisbehaviourReport:
        config = self.config
        observations = []
        evidences, tested = [], []
        for objects, name in ((self._theirs, "NotSeen"), (self._mine, "Missing")):
            counted = {key: o for key, o in objects.items() if o.seen >= config.frames}
            absent = {key: o for key, o in counted.items() if o.missing >= config.contradicted * o.seen}
            probability = np.array([o.probability for o in counted.values()])
            evidence, share = share_evidence(np.array([key in absent for key in counted], np.bool_), probability)
            evidences.append(evidence)
            tested.append(len(counted))
            if evidence >= config.evidence and len(absent) >= config.objects:
                displaced = sum(2 * o.near_removed > o.missing for o in absent.values())
                if name == "NotSeen" and 2 * displaced > len(absent):
                    name = "Displaced"
                label: Any = f"PerceivedObject-{name}"
                observations.append(Observation(label, 4, evidence, tuple(sorted(absent)), share))
        if self._repeats >= config.repeats:
            observations.append(Observation("ObjectList-Replayed", 2, np.inf, (), 1.0))
        exclude = any(o.evidence >= config.exclusion for o in observations)
        return MisbehaviourReport(now, tuple(observations), evidences[0], evidences[1], (tested[0], tested[1]), exclude)


def share_evidence(missing: BoolArray, probability: FloatArray) -> tuple[float, float]:
    """Log-likelihood ratio of "a share of the objects is false" against "all are honest", and the most likely share.

    Args:
        missing: (N,) whether each object is missing from the list it is compared with.
        probability: (N,) that it is if it is honest; a false one always is.
    """
    if not len(missing):
        return 0.0, 0.0
    p = probability[:, None]
    ratio = np.where(missing[:, None], (1.0 - _SHARES) + _SHARES / p, 1.0 - _SHARES)
    evidence = np.log(ratio).sum(axis=0)
    best = int(evidence.argmax())
    return (float(evidence[best]), float(_SHARES[best])) if evidence[best] > 0.0 else (0.0, 0.0)


def _geometry(boxes: Boxes) -> Boxes:
    return boxes.replace(score=None, track_id=None, label=None)
