"""Results of one sequence under some conditions, in memory and on disk.

A file is an `.npz` with three arrays: `document`, the bytes of a JSON document with all but the boxes; `boxes`, the
(M, 8) detections x, y, z, l, w, h [m], yaw [rad], score of all conditions and frames in the document's order; and
`truth`, the (K, 7) true boxes of all frames. It is written atomically and contains no pickled objects.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets.atomic_files import atomic_write
from cobevglue.experiments.condition import Condition
from cobevglue.typing import FloatArray, IntArray

__all__ = [
    "ConditionResult",
    "FrameResult",
    "FrameTruth",
    "ReceivedPose",
    "ScenarioResult",
    "read_result",
    "write_result",
]

_FORMAT = 1


@dataclass(frozen=True, slots=True)
class ReceivedPose:
    """The pose and messages of one collaborator in one frame.

    Attributes:
        agent: its name.
        translation_error: of its pose [m]; infinite where it was refused.
        yaw_error: of its pose, magnitude [rad]; infinite where it was refused.
        landing_error: distance of its boxes from their places by the true pose [m]; infinite where it was refused.
        reason: why its pose was refused; "" where it was accepted.
        message_bytes: bytes sent, by kind of message.
        alignment_bytes: bytes of these for alignment.
    """

    agent: str
    translation_error: float
    yaw_error: float
    landing_error: float
    reason: str
    message_bytes: dict[str, int]
    alignment_bytes: int

    @property
    def accepted(self) -> bool:
        """Whether its pose was used."""
        return math.isfinite(self.translation_error)

    def success(self, k: float) -> bool:
        """Accepted, within k metres and k degrees."""
        return self.translation_error < k and self.yaw_error < math.radians(k)


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """The ego's output in one frame.

    Attributes:
        boxes: detections with scores, in the ego's LiDAR frame.
        received: the pose of each collaborator.
        seconds: time of each stage [s].
    """

    boxes: Boxes
    received: tuple[ReceivedPose, ...]
    seconds: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class FrameTruth:
    """Ground truth of one frame.

    Attributes:
        timestamp: name of the frame.
        objects: K vehicles labelled by any agent, in the ego's LiDAR frame.
        point_count: (K,) points of all agents together on each of them.
        co_visible: by collaborator, number of objects that both it and the ego detected.
        seconds: time of each perception stage, summed over agents [s].
    """

    timestamp: str
    objects: Boxes
    point_count: IntArray
    co_visible: dict[str, int]
    seconds: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class ConditionResult:
    """A sequence under one condition.

    Attributes:
        condition: settings of the run.
        fingerprint: of the method's weights.
        frames: by frame index in `ScenarioResult.truth`.
    """

    condition: Condition
    fingerprint: str
    frames: dict[int, FrameResult]


@dataclass(frozen=True, slots=True, eq=False)
class ScenarioResult:
    """A sequence under all conditions.

    Attributes:
        scenario: name of the sequence.
        ego: name of the ego; "" where no frame had a vehicle with a cloud.
        truth: of each frame used.
        left_out: reasons for skipping, with their counts: "agents without a cloud", "frames without the ego".
        conditions: by their keys.
    """

    scenario: str
    ego: str
    truth: list[FrameTruth]
    left_out: dict[str, int]
    conditions: dict[str, ConditionResult] = field(default_factory=dict)


def write_result(path: Path, result: ScenarioResult) -> None:
    """Write the file atomically."""
    truth = [
        {
            "timestamp": one.timestamp,
            "objects": len(one.objects),
            "labels": None if one.objects.label is None else one.objects.label.tolist(),
            "point_count": one.point_count.tolist(),
            "co_visible": one.co_visible,
            "seconds": one.seconds,
        }
        for one in result.truth
    ]
    conditions = [
        {
            "condition": run.condition.model_dump(mode="json"),
            "fingerprint": run.fingerprint,
            "frames": [
                {
                    "frame": index,
                    "boxes": len(frame.boxes),
                    "heard": [_finite(asdict(pose)) for pose in frame.received],
                    "seconds": frame.seconds,
                }
                for index, frame in run.frames.items()
            ],
        }
        for run in result.conditions.values()
    ]
    document = {
        "format": _FORMAT,
        "scenario": result.scenario,
        "ego": result.ego,
        "left_out": result.left_out,
        "truth": truth,
        "conditions": conditions,
    }
    detections = [frame.boxes for run in result.conditions.values() for frame in run.frames.values()]
    with atomic_write(path) as partial, partial.open("wb") as file:
        np.savez_compressed(
            file,
            document=np.frombuffer(json.dumps(document, allow_nan=False).encode(), np.uint8),
            boxes=_rows(detections, 8).astype(np.float32),
            truth=_rows([one.objects for one in result.truth], 7),
        )


def read_result(path: Path) -> ScenarioResult:
    """Read a file of `write_result`.

    Raises:
        ValueError: the file is damaged or not a result; names it.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            document = json.loads(file["document"].tobytes())
            boxes, truth = file["boxes"].astype(np.float64), file["truth"]
        if document["format"] != _FORMAT:
            raise ValueError(f"format {document['format']}, this version of cobevglue reads format {_FORMAT}")
        return _result(document, boxes, truth)
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: damaged, or not the result of a sequence: {error}") from None


def _result(document: Mapping[str, Any], boxes: FloatArray, truth: FloatArray) -> ScenarioResult:
    truths, row = [], 0
    for one in document["truth"]:
        objects = _boxes(truth[row : row + one["objects"]], one["labels"])
        counts = np.array(one["point_count"], np.int64)
        truths.append(FrameTruth(one["timestamp"], objects, counts, one["co_visible"], one["seconds"]))
        row += one["objects"]
    conditions, row = {}, 0
    for one in document["conditions"]:
        frames = {}
        for frame in one["frames"]:
            received = tuple(ReceivedPose(**_infinite(part)) for part in frame["heard"])
            frames[frame["frame"]] = FrameResult(_boxes(boxes[row : row + frame["boxes"]]), received, frame["seconds"])
            row += frame["boxes"]
        condition = Condition(**one["condition"])
        conditions[condition.key] = ConditionResult(condition, one["fingerprint"], frames)
    return ScenarioResult(document["scenario"], document["ego"], truths, document["left_out"], conditions)


def _rows(parts: Sequence[Boxes], width: int) -> FloatArray:
    """(M, width) box parameters of all parts."""
    rows = [np.zeros((0, width))]
    for boxes in parts:
        score = [boxes.score] if boxes.score is not None else [np.zeros(len(boxes))]
        rows.append(np.column_stack([boxes.center, boxes.size, boxes.yaw, *score])[:, :width])
    return np.concatenate(rows)


def _boxes(rows: FloatArray, labels: list[str] | None = None) -> Boxes:
    score = rows[:, 7] if rows.shape[1] == 8 else None
    return Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6], score, label=labels)


def _finite(record: dict[str, Any]) -> dict[str, Any]:
    """Infinite errors of refused poses as null: JSON has no infinity."""
    return {k: None if isinstance(v, float) and math.isinf(v) else v for k, v in record.items()}


def _infinite(record: dict[str, Any]) -> dict[str, Any]:
    return {k: math.inf if v is None else v for k, v in record.items()}
