"""Draw the figures of docs/alignment_method.md: `python tools/method_figures.py docs/images`.

The scene is a simulated motorway on which the other agent's list is 0.2 s late. The figures show the two lists under
the true pose as sent, the lists after motion compensation by the estimated time offset, and the estimates over time.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from cobevglue import Alignment, BEVGlue, Boxes
from cobevglue.evaluation.alignment import PairFrame, landing_error
from cobevglue.evaluation.scene_data import scene_sequence

DELAY = 0.2
FRAME = 30
EGO_COLOUR, OTHER_COLOUR = "#1f4e79", "#d9822b"


def main() -> None:
    """Write late_list.png."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    frames = scene_sequence("motorway", 1, DELAY).frames
    glue = BEVGlue()
    alignments = [glue.align(f.ego, f.other, f.time, ego_body=f.ego_body, other_body=f.other_body) for f in frames]
    figure, (sent, moved, settled) = plt.subplots(
        3, 1, figsize=(10, 8), height_ratios=[1, 1, 0.8], layout="constrained"
    )
    frame, alignment = frames[FRAME], alignments[FRAME]
    draw(sent, frame, frame.other.transform(frame.ego_SE2_other), f"as sent, {DELAY:g} s late, under the true pose")
    draw(moved, frame, alignment.boxes_at_ego_instant(frame.other), "brought to the ego's instant by the estimates")
    settle(settled, frames, alignments)
    figure.savefig(folder / "late_list.png", dpi=110)


def draw(axes: Axes, frame: PairFrame, other: Boxes, title: str) -> None:
    """Draw both lists in the ego frame."""
    for boxes, colour, label in ((frame.ego, EGO_COLOUR, "ego's list"), (other, OTHER_COLOUR, "other's list")):
        for i, corners in enumerate(boxes.bev_corners()):
            axes.add_patch(Polygon(corners, fill=False, color=colour, lw=1.6, label=label if i == 0 else None))
    axes.set(xlim=(-75, 75), ylim=(-12, 30), aspect="equal", title=title, xlabel="x [m]", ylabel="y [m]")
    axes.legend(loc="upper right", ncols=2)


def settle(axes: Axes, frames: list[PairFrame], alignments: list[Alignment]) -> None:
    """Draw the estimated time offset and the landing error over time."""
    times = np.arange(len(frames)) * 0.1
    offset = [1000 * a.time_offset if a.accepted else np.nan for a in alignments]
    error = [
        100 * landing_error(a.ego_SE2_other, f.ego_SE2_other, f.other) if a.ego_SE2_other else np.nan
        for f, a in zip(frames, alignments, strict=True)
    ]
    axes.plot(times, offset, color=EGO_COLOUR, label="time offset [ms]")
    axes.axhline(-1000 * DELAY, color=EGO_COLOUR, ls=":", label="true offset")
    axes.plot(times, error, color=OTHER_COLOUR, label="landing error [cm]")
    axes.set(xlabel="time [s]", ylim=(-260, 260), title="estimates over the frames (before the first: refused)")
    axes.grid(alpha=0.3)
    axes.legend(ncols=3)


if __name__ == "__main__":
    main()
