"""Draw the picture of docs/interoperability.md: the values of one car's box in the axes of each format.

python tools/draw_axes.py docs/images/axes.png
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable

from matplotlib.axes import Axes

from cobevglue import Boxes
from cobevglue.interop import centers_from_boxes, kitti_from_boxes, nuscenes_from_boxes
from cobevglue.visualization.style import EGO, OTHER, add_axes, light_grid, new_figure, save_figure, set_title

CAR = Boxes([(10.0, -3.0, -1.0)], [(4.5, 1.9, 1.5)], [math.radians(30.0)])


def main() -> None:
    """Draw the picture to the given path."""
    x, y, z, height, width, length, yaw = centers_from_boxes(CAR)[0]
    record = nuscenes_from_boxes(CAR)[0]
    kitti = kitti_from_boxes(CAR)[0]
    quaternion = _row(round(value, 2) for value in record["rotation"])
    panels = [
        (
            "cobevglue",
            ("x", "y"),
            -1,
            f"center {_row(CAR.center[0])}\nsize (l, w, h) {_row(CAR.size[0])}\nyaw {CAR.yaw[0]:.2f}",
        ),
        (
            "OpenCOOD: OPV2V",
            ("x", "y"),
            1,
            f"x, y, z  {_row((x, y, z))}\nh, w, l  {_row((height, width, length))}\nyaw {yaw:.2f}",
        ),
        (
            "nuScenes: vehicle",
            ("x", "y"),
            -1,
            f"translation {_row(record['translation'])}\nsize (w, l, h) {_row(record['size'])}\nrotation {quaternion}",
        ),
        (
            "KITTI: camera",
            ("z", "x"),
            1,
            f"h, w, l  {_row(kitti[:3])}\nx, y, z  {_row(kitti[3:6])}\nrotation_y {kitti[6]:.2f}",
        ),
    ]
    figure = new_figure(12.0, 4.6)
    for axes, (title, names, side, text) in zip(add_axes(figure, 1, len(panels)), panels, strict=True):
        draw(axes, names, side)
        set_title(axes, title)
        axes.set_xlabel(text, fontsize=9, loc="left", family="monospace")
    save_figure(figure, sys.argv[1])


def draw(axes: Axes, names: tuple[str, str], side: int) -> None:
    """Draw the sensor, its two axes and the car, in a top view with the front up.

    Args:
        axes: the plot.
        names: names of the forward axis and of the lateral axis.
        side: 1 if the lateral axis points to the right, -1 if to the left.
    """
    corners = CAR.bev_corners()[0]
    axes.fill(-corners[:, 1], corners[:, 0], facecolor="none", edgecolor=OTHER, linewidth=1.5)
    front = corners[[0, 3]].mean(axis=0)
    axes.plot([-CAR.center[0, 1], -front[1]], [CAR.center[0, 0], front[0]], color=OTHER)
    style = {"arrowstyle": "<-", "color": EGO, "linewidth": 2.0}  # arrows of annotations start at their text
    for name, end, at in ((names[0], (0.0, 6.0), "bottom"), (names[1], (4.0 * side, 0.0), "center")):
        axes.annotate(name, (0.0, 0.0), end, arrowprops=style, color=EGO, fontsize=12, ha="center", va=at)
    axes.plot(0.0, 0.0, "o", color=EGO)
    axes.set(xlim=(-6.0, 8.0), ylim=(-2.0, 14.0), aspect="equal")
    axes.set_xticklabels([])
    axes.set_yticklabels([])
    axes.tick_params(length=0)
    light_grid(axes)


def _row(values: Iterable[float]) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"


if __name__ == "__main__":
    main()
