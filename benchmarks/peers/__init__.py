"""Matchers of other papers on BEVGlue's input, each written from its paper, for `benchmarks/alignment.py --only peers`.

They are no part of the package. None is given a pose, a trajectory or tracks; those that expect a rough pose run
without.
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
"""From the name that `peers.search` takes to the class."""
