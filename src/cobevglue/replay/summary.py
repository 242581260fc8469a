"""What a replay found: numbers for the terminal and JSON, and the series that the page draws."""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cobevglue.alignment.to_dict import alignment_to_dict
from cobevglue.messages import to_dict
from cobevglue.replay.replay import Replay, ReplayFrame
from cobevglue.typing import FloatArray

__all__ = ["AgentSeries", "Summary", "frame_line"]


@dataclass(slots=True, eq=False)
class AgentSeries:
    """One other agent over the frames with a list of it.

    Attributes:
        rows: of each frame time of the ego [s], risk, time offset [s], x, y [m] and yaw [rad] of the pose; NaN where
            the pose was refused.
        refused: number of frames by the cause of the refusal.
        last: the last alignment, as a JSON document.
    """

    rows: list[tuple[float, float, float, float, float, float]] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    last: dict[str, Any] = field(default_factory=dict)

    @property
    def table(self) -> FloatArray:
        """(F, 6) the rows."""
        return np.array(self.rows, dtype=np.float64).reshape(-1, 6)

    @property
    def accepted(self) -> int:
        """Number of frames with a pose."""
        return int(np.isfinite(self.table[:, 3]).sum())


@dataclass(slots=True, eq=False)
class Summary:
    """Collects the frames of a replay.

    Attributes:
        frames: number of lists of the ego.
        alone: number of them without a list of any other agent.
        agents: by other agent.
        own_objects: number of the ego's objects over all frames.
        fused_objects: number of fused objects over all frames.
    """

    frames: int = 0
    alone: int = 0
    agents: dict[str, AgentSeries] = field(default_factory=dict)
    own_objects: int = 0
    fused_objects: int = 0

    def add(self, frame: ReplayFrame, ego: str) -> None:
        """Count a frame."""
        self.frames += 1
        self.alone += not frame.seen.alignments
        self.own_objects += len(frame.seen.lists[ego])
        self.fused_objects += len(frame.seen.objects)
        for name, alignment in frame.seen.alignments.items():
            series = self.agents.setdefault(name, AgentSeries())
            pose = alignment.ego_SE2_other
            numbers = (math.nan,) * 4 if pose is None else (alignment.time_offset, pose.x, pose.y, pose.yaw)
            series.rows.append((frame.time, alignment.risk, *numbers))
            if pose is None:
                series.refused[alignment.reason.split(":")[0].split(";")[0]] += 1
            series.last = alignment_to_dict(alignment)

    @property
    def accepted(self) -> int:
        """Number of accepted poses, of all agents."""
        return sum(series.accepted for series in self.agents.values())

    def to_dict(self, replay: Replay) -> dict[str, Any]:
        """JSON document: metres, radians, seconds."""
        return {
            "recording": str(replay.recording.path),
            "ego": replay.ego,
            "frames": self.frames,
            "frames_without_other": self.alone,
            "objects_per_frame": {
                "ego": self.own_objects / max(self.frames, 1),
                "fused": self.fused_objects / max(self.frames, 1),
            },
            "topics": {
                agent: {
                    "topic": stream.topic,
                    "lists": stream.lists,
                    "rate": stream.rate,
                    "longest_gap": stream.longest_gap,
                    "unstamped": stream.unstamped,
                    "doubled": stream.doubled,
                    "late": stream.late,
                    "set_back": stream.set_back,
                    "objects_without_size": stream.without_size,
                    "new_identities": stream.new_identities,
                }
                for agent, stream in replay.streams.items()
            },
            "agents": {
                name: {
                    "frames": len(series.rows),
                    "accepted": series.accepted,
                    "refused": dict(series.refused.most_common()),
                    "median_time_offset": _median(series.table[:, 2]),
                    "median_risk_of_accepted": _median(series.table[np.isfinite(series.table[:, 3]), 1]),
                    "last": series.last,
                }
                for name, series in self.agents.items()
            },
        }


def frame_line(frame: ReplayFrame) -> str:
    """A frame as a line of JSON: time stamps, alignments and fused objects."""
    document = {
        "frame": frame.index,
        "time": frame.time,
        "stamps": frame.stamps,
        "alignments": {name: alignment_to_dict(alignment) for name, alignment in frame.seen.alignments.items()},
        "objects": to_dict(frame.seen.objects)["boxes"],
    }
    return json.dumps(document, ensure_ascii=False, allow_nan=False)


def _median(values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None
