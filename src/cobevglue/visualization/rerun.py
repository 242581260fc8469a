"""Alignments as a recording for the Rerun viewer: boxes, poses and verdicts over time.

    with open_recording("drive.rrd") as recording:
        for …:
            log_frame(recording, {"car1": boxes1, "car2": boxes2}, "car1", {"car2": alignment}, time)

`rerun drive.rrd` shows it. Everything in space is in the ego frame. Needs: pip install 'cobevglue[viewer]'

| entity | content |
|---|---|
| `agents/NAME/boxes` | the boxes of the agent; none while its alignment is refused |
| `agents/NAME/pose` | where the agent is, as axes (x red, y green) |
| `agents/NAME/matches` | lines between the boxes of the ego and the agent that are one object |
| `fused` | the fused objects, if given |
| `verdict/NAME` | text: accepted, or the reason of the refusal |
| `verdict/NAME/accepted` | 1 or 0 |
| `verdict/NAME/evidence`, `margin` | of the alignment [nats] |
| `verdict/NAME/position_std`, `yaw_std` | standard deviations from its covariance [m], [degrees] |
| `verdict/NAME/time_offset` | of the agent's list [s] |
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cobevglue.alignment.alignment import Alignment
from cobevglue.boxes import Boxes
from cobevglue.se2 import SE2
from cobevglue.visualization.style import EGO, MATCH, OTHER

if TYPE_CHECKING:
    from rerun import RecordingStream

__all__ = ["log_frame", "open_recording"]

_AXIS = 3.0  # length of the axes that show an agent's pose [m]


@contextmanager
def open_recording(path: str | Path, name: str = "cobevglue") -> Iterator[RecordingStream]:
    """A recording that is written to a file, complete when the block ends.

    Args:
        path: the file, usually `.rrd`; its folder must exist.
        name: of the application, as the viewer shows it.

    Raises:
        ModuleNotFoundError: rerun-sdk is not installed.
        OSError: the folder does not exist, or the file cannot be written.
    """
    rr = _rerun()
    if not Path(path).parent.is_dir():
        raise FileNotFoundError(f"{Path(path).parent} does not exist")
    recording = rr.RecordingStream(name)
    try:
        recording.save(str(path))
    except RuntimeError as error:  # such as a full disk
        raise OSError(f"{path}: {error}") from None
    try:
        recording.log("/", rr.ViewCoordinates.FLU, static=True)
        yield recording
    finally:
        recording.disconnect()


def log_frame(
    recording: RecordingStream,
    boxes: Mapping[str, Boxes],
    ego: str,
    alignments: Mapping[str, Alignment],
    time: float,
    fused: Boxes | None = None,
) -> None:
    """Log one frame.

    Args:
        recording: such as that of `open_recording`, or one connected to a viewer.
        boxes: of each agent, in its own frame.
        ego: name of the ego among them.
        alignments: of every other agent.
        time: of the frame [s]; the viewer's timeline is called `time`.
        fused: fused objects in the ego frame, or None.

    Raises:
        ValueError: an agent has boxes without an alignment, or the ego has none.
        ModuleNotFoundError: rerun-sdk is not installed.
    """
    rr = _rerun()
    missing = [name for name in (ego, *alignments) if name not in boxes]
    missing += [name for name in boxes if name != ego and name not in alignments]
    if missing:
        raise ValueError(f"agent {missing[0]!r} must have boxes and, unless it is the ego {ego!r}, an alignment")
    recording.set_time("time", duration=time)
    recording.log(["agents", ego, "boxes"], _boxes(boxes[ego], EGO))
    recording.log(["agents", ego, "pose"], *_pose(SE2()))
    if fused is not None:
        recording.log("fused", _boxes(fused, MATCH))
    for name, alignment in alignments.items():
        if alignment.ego_SE2_other is None:
            # Cleared, not left out: the viewer would go on showing the boxes of an earlier frame.
            recording.log(["agents", name], rr.Clear(recursive=True))
        else:
            moved = alignment.boxes_at_ego_instant(boxes[name])
            recording.log(["agents", name, "boxes"], _boxes(moved, OTHER))
            recording.log(["agents", name, "pose"], *_pose(alignment.ego_SE2_other))
            ends = np.stack([boxes[ego].center[alignment.matches[:, 0]], moved.center[alignment.matches[:, 1]]], axis=1)
            recording.log(["agents", name, "matches"], rr.LineStrips3D(list(ends), colors=_rgb(MATCH)))
        _log_verdict(recording, name, alignment)


def _log_verdict(recording: RecordingStream, name: str, alignment: Alignment) -> None:
    rr = _rerun()
    text = f"accepted, {len(alignment.matches)} matches" if alignment.accepted else f"refused: {alignment.reason}"
    recording.log(["verdict", name], rr.TextLog(text, level="INFO" if alignment.accepted else "WARN"))
    variance = np.diag(alignment.covariance)
    plots = {
        "accepted": float(alignment.accepted),
        "evidence": alignment.evidence,
        "margin": alignment.margin,
        "position_std": math.sqrt(variance[:2].sum()),
        "yaw_std": math.degrees(math.sqrt(variance[2])),
        "time_offset": alignment.time_offset if alignment.accepted else math.nan,
    }
    for plot, value in plots.items():
        if math.isfinite(value):
            recording.log(["verdict", name, plot], rr.Scalars(value))


def _boxes(boxes: Boxes, color: str) -> Any:
    """The boxes as an archetype, labelled with class and track id."""
    rr = _rerun()
    half_yaw = boxes.yaw / 2.0
    zero = np.zeros(len(boxes))
    words = [
        " ".join(str(column[row]) for column in (boxes.label, boxes.track_id) if column is not None)
        for row in range(len(boxes))
    ]
    return rr.Boxes3D(
        centers=boxes.center,
        half_sizes=boxes.size / 2.0,
        quaternions=np.column_stack([zero, zero, np.sin(half_yaw), np.cos(half_yaw)]),
        colors=_rgb(color),
        labels=words if any(words) else None,
    )


def _pose(ego_SE2_agent: SE2) -> tuple[Any, Any]:
    """The pose, and axes that show it."""
    rr = _rerun()
    half_yaw = ego_SE2_agent.yaw / 2.0
    return (
        rr.Transform3D(
            translation=[ego_SE2_agent.x, ego_SE2_agent.y, 0.0],
            quaternion=[0.0, 0.0, math.sin(half_yaw), math.cos(half_yaw)],
        ),
        rr.Arrows3D(vectors=[[_AXIS, 0.0, 0.0], [0.0, _AXIS, 0.0]], colors=[[200, 30, 30], [30, 150, 30]]),
    )


def _rgb(color: str) -> list[int]:
    """Red, green and blue of #rrggbb."""
    return [int(color[i : i + 2], 16) for i in (1, 3, 5)]


def _rerun() -> Any:
    """The rerun module: imported on first use, since it takes a second and few need it."""
    try:
        import rerun
    except ImportError as error:
        raise ModuleNotFoundError(
            f"recordings need rerun-sdk: pip install 'cobevglue[viewer]' ({error})", name="rerun"
        ) from None
    return rerun
