"""The node's own object lists, as one line of JSON each.

    {"time": 12.3, "boxes": [{"x": 12.5, "y": -3.0, "l": 4.5, "w": 1.9, "yaw": 0.1}, …], "body": {"x": 0, …}}

An object list as `cobevglue.messages.object_list` has it, with `time`, its time stamp [s], and `body`, the own vehicle
in its own frame. Both may be left out.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

from cobevglue.boxes import Boxes
from cobevglue.messages import from_dict, to_dict

__all__ = ["OwnList", "parse_list", "write_list"]


@dataclass(frozen=True, slots=True, eq=False)
class OwnList:
    """What the agent itself sees at one time.

    Attributes:
        boxes: the objects in its own frame.
        time: time stamp [s], on any clock.
        body: one-row box of its own vehicle in the same frame, or None.
    """

    boxes: Boxes
    time: float
    body: Boxes | None = None


def parse_list(line: str | bytes, default_time: float) -> OwnList:
    """The list in a line of JSON.

    Args:
        line: the text.
        default_time: time stamp if the line has none [s].

    Raises:
        ValueError: one line that says what is wrong, with row and field.
    """
    try:
        document: Any = json.loads(line)
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError
        raise ValueError(f"object list: not JSON: {error}") from None
    if not isinstance(document, dict):
        return OwnList(from_dict(document), default_time)  # which says what is wrong
    time, body = document.pop("time", None), document.pop("body", None)
    if time is None:
        time = default_time
    if isinstance(time, bool) or not isinstance(time, (int, float)) or not math.isfinite(time):
        raise ValueError(f"object list: time must be a finite number of seconds, got {time!r}")
    own = None
    if body is not None:
        own = from_dict({"boxes": [body]}, source="object list: body").replace(score=None, track_id=None, label=None)
    return OwnList(from_dict(document), float(time), own)


def write_list(own: OwnList) -> str:
    """The line of JSON for a list, without a line break."""
    document: dict[str, Any] = {"time": own.time, **to_dict(own.boxes)}
    if own.body is not None:
        document["body"] = to_dict(own.body)["boxes"][0]
    return json.dumps(document, ensure_ascii=False, allow_nan=False)
