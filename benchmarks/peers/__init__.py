"""Matchers of other papers on BEVGlue's input, implemented from the papers: `benchmarks/alignment.py --only peers`.

They are not part of the package. None of them receives a pose, a trajectory or tracks; matchers that use an initial
pose run without one.
"""

from __future__ import annotations

from peers.cbm import CBM
from peers.clipper import Clipper
from peers.free_align import FreeAlign
from peers.single_frame import SingleFrameMatcher
from peers.v2x_reg import V2XReg
from peers.vips import VIPS

__all__ = ["CBM", "PEERS", "VIPS", "Clipper", "FreeAlign", "SingleFrameMatcher", "V2XReg"]

PEERS: dict[str, type[SingleFrameMatcher]] = {
    "FreeAlign": FreeAlign,
    "VIPS": VIPS,
    "V2XReg": V2XReg,
    "CBM": CBM,
    "Clipper": Clipper,
}
"""Matchers by their name in `peers.search`."""
