"""The objects of a standard message: boxes and further columns."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from cobevglue.boxes import Boxes, covers_origin
from cobevglue.messages.object_message import MessageError
from cobevglue.typing import BoolArray, FloatArray

__all__ = ["Columns"]


@dataclass(frozen=True, eq=False)
class Columns:
    """Boxes and what standard messages say of them beside; see `CollectivePerception`."""

    boxes: Boxes
    velocity: FloatArray | None = None
    age: FloatArray | None = None
    measurement_offset: FloatArray | None = None
    position_std: FloatArray | None = None
    yaw_std: FloatArray | None = None

    def __getitem__(self, rows: BoolArray) -> Columns:
        """The rows that a mask selects."""
        columns: dict[str, Any] = {}
        for field in fields(self):
            values = getattr(self, field.name)
            columns[field.name] = None if values is None else values[rows]
        return Columns(**columns)

    def with_own_vehicle(self, body: Boxes, object_id: int) -> Columns:
        """These rows and one more: the sender's vehicle, of which nothing but the box is known.

        Raises:
            MessageError: it does not stand on the origin.
        """
        if not covers_origin(body)[0]:
            raise MessageError("body must be located at the origin of the frame, the reference position")
        boxes = self.boxes
        row = body.replace(
            score=None if boxes.score is None else [0.0],
            track_id=[object_id],
            label=None if boxes.label is None else ["unknown"],
        )
        columns: dict[str, Any] = {"boxes": Boxes.concatenate([boxes, row])}
        for field in fields(self)[1:]:
            values = getattr(self, field.name)
            if values is not None:
                unknown = 0.0 if field.name == "measurement_offset" else math.nan
                columns[field.name] = np.concatenate([values, np.full((1, *values.shape[1:]), unknown)])
        return Columns(**columns)

    def split_own_vehicle(self, object_id: int) -> tuple[Columns, Boxes | None]:
        """The other rows, and the sender's vehicle: the object with this id, if it stands on the origin."""
        ids = self.boxes.track_id
        if ids is None:
            return self, None
        own = (ids == object_id) & covers_origin(self.boxes)
        if not own.any():
            return self, None
        body = self.boxes[own]
        return self[~own], Boxes(body.center, body.size, body.yaw)
