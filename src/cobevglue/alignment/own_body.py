"""An agent's own vehicle: an object that the other agent observes and the agent's own detector does not report."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from cobevglue.alignment.alignment import Alignment
from cobevglue.boxes import Boxes
from cobevglue.iou import bev_iou

__all__ = ["append_body", "check_bodies", "known_bodies"]

_TRACK_ID = 2**52
"""Track id of the own vehicle: no tracker gets there."""


def known_bodies(ego_body: Boxes | None, other_body: Boxes | None) -> dict[str, Any]:
    """The keyword arguments of `BEVGlue.align` for the own vehicles that are known; {} if none is.

    So aligners that do not use own vehicles need not accept them.
    """
    bodies = {"ego_body": ego_body, "other_body": other_body}
    return {name: body for name, body in bodies.items() if body is not None}


def append_body(boxes: Boxes, body: Boxes | None, name: str) -> Boxes:
    """The boxes, followed by the agent's own vehicle where it is given.

    Args:
        boxes: N boxes in the agent's frame.
        body: one-row box of its own vehicle in the same frame, or None.
        name: of the argument, for errors.

    Returns:
        N or N + 1 boxes. Scores and labels are dropped with a body.

    Raises:
        ValueError: `body` has not exactly one row.
    """
    if body is None:
        return boxes
    if len(body) != 1:
        raise ValueError(f"{name} must have one row, got {len(body)}")
    ids = boxes.track_id
    return Boxes(
        np.concatenate([boxes.center, body.center]),
        np.concatenate([boxes.size, body.size]),
        np.concatenate([boxes.yaw, body.yaw]),
        track_id=None if ids is None else np.append(ids, _TRACK_ID),
    )


def check_bodies(
    alignment: Alignment, ego: Boxes, other: Boxes, ego_body: Boxes | None, other_body: Boxes | None
) -> Alignment:
    """The alignment with matches of `ego` and `other` only; refused where the two vehicles would overlap.

    Args:
        alignment: of the lists with their bodies appended.
        ego: the list without a body, in the ego frame.
        other: likewise, in the other agent's frame.
        ego_body: the ego's own vehicle, or None.
        other_body: the other agent's own vehicle, or None.
    """
    pose = alignment.ego_SE2_other
    if pose is None:
        return alignment
    if ego_body is not None and other_body is not None and bev_iou(ego_body, other_body.transform(pose))[0, 0] > 0.0:
        reason = "the pose places the two agents' own vehicles into each other"
        return Alignment.refused(reason, alignment.evidence, alignment.margin, 1.0)
    listed = (alignment.matches < [len(ego), len(other)]).all(axis=1)
    return alignment if listed.all() else replace(alignment, matches=alignment.matches[listed])
