"""The option `--body`: the agent's own vehicle."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cobevglue.boxes import Boxes

__all__ = ["parse_body"]


def parse_body(text: str) -> Boxes:
    """One-row box of a vehicle from LENGTH,WIDTH[,X[,Y]] in metres; by default its middle is the frame's origin.

    Raises:
        ValueError: these are not two to four numbers, or no size.
    """
    from cobevglue.boxes import Boxes

    length, width, x, y = ([float(number) for number in text.split(",")] + [0.0, 0.0])[:4]
    return Boxes([(x, y, 0.0)], [(length, width, 1.5)], [0.0])
