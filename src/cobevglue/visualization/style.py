"""Colours, figures and files that all pictures share.

Figures are made with matplotlib's objects, without pyplot: nothing is global, and no display is needed. The colours
are from the palette of Okabe and Ito, which people with any kind of colour vision can tell apart; whose a box is can be
told from how it is drawn, too (the ego's are filled, the other's are outlines).
"""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

__all__ = [
    "EGO",
    "GIVEN_POSE",
    "MATCH",
    "OTHER",
    "TRUTH",
    "add_axes",
    "check_picture_name",
    "figure_png",
    "is_cobevglue",
    "legend_below",
    "light_grid",
    "new_figure",
    "picture_suffixes",
    "same_scale",
    "save_figure",
    "set_title",
    "style_bev",
]

EGO = "#0072B2"
"""Blue: the ego and its detections."""
OTHER = "#D55E00"
"""Orange: the other agent and its detections."""
MATCH = "#009E73"
"""Green: co-visible objects, and results of BEVGlue."""
GIVEN_POSE = "#AA4499"
"""Purple: results with a given pose (GPS), noisy or attacked."""
TRUTH = "#8A8A8A"
"""Grey: ground truth."""

_SETTINGS: Any = {
    "font.size": 11.0,
    "axes.edgecolor": "#999999",
    "axes.labelcolor": "#444444",
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "legend.frameon": False,
    "legend.fontsize": 10.5,
    "savefig.facecolor": "white",
}


def new_figure(width: float, height: float) -> Figure:
    """An empty figure in the project's style with constrained layout.

    Args:
        width: of the picture [inches].
        height: of the picture [inches].
    """
    with rc_context(_SETTINGS):
        return Figure(figsize=(width, height), layout="compressed")


def add_axes(figure: Figure, rows: int, columns: int, heights: Sequence[float] | None = None) -> list[Axes]:
    """A grid of plots, row by row, in the project's style.

    Args:
        figure: where the plots go.
        rows: how many rows.
        columns: how many plots in a row.
        heights: of the rows, relative to each other; equal where left out.
    """
    with rc_context(_SETTINGS):  # settings apply to axes as they are made
        grid = figure.add_gridspec(rows, columns, height_ratios=heights)
        return [figure.add_subplot(grid[row, column]) for row in range(rows) for column in range(columns)]


def style_bev(axes: Axes, title: str) -> None:
    """Format a plot as a map: equal scales in metres, a light grid."""
    set_title(axes, title)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("x, forward [m]")
    axes.set_ylabel("y, left [m]")
    light_grid(axes)


def light_grid(axes: Axes) -> None:
    """A grid behind everything else."""
    axes.grid(True, linewidth=0.6, color="#E6E6E6")
    axes.set_axisbelow(True)


def set_title(axes: Axes, title: str, size: float = 12.0) -> None:
    """Set the title of a plot, left-aligned and bold; size in points."""
    axes.set_title(title, loc="left", fontsize=size, fontweight="bold")


def same_scale(plots: Sequence[Axes], margin: float = 2.0) -> None:
    """Make maps square, with the same number of metres an inch, each centred on what is in it.

    Args:
        plots: maps whose content is drawn already.
        margin: free space around the content of the largest [m].
    """
    limits = [(*axes.get_xlim(), *axes.get_ylim()) for axes in plots]
    half = margin + max(max(right - left, top - bottom) / 2.0 for left, right, bottom, top in limits)
    for axes, (left, right, bottom, top) in zip(plots, limits, strict=True):
        x, y = (left + right) / 2.0, (bottom + top) / 2.0
        axes.set_xlim(x - half, x + half)
        axes.set_ylim(y - half, y + half)


def legend_below(figure: Figure, columns: int = 6) -> None:
    """Add one legend below the plots, with each label of any plot once."""
    named: dict[str, Artist] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    with rc_context(_SETTINGS):
        figure.legend(list(named.values()), list(named), loc="outside lower center", ncol=columns)


def is_cobevglue(name: str) -> bool:
    """Whether a row or a line of this name is CoBEVGlue's, which is highlighted."""
    return name.casefold().startswith("cobevglue")


def figure_png(figure: Figure, dpi: float = 110.0) -> bytes:
    """The figure as the bytes of a PNG file with `dpi` dots per inch."""
    file = BytesIO()
    figure.savefig(file, format="png", dpi=dpi)
    return file.getvalue()


def picture_suffixes() -> list[str]:
    """File name endings that `save_figure` knows: `.pdf`, `.png`, `.svg` and others."""
    return sorted(f".{kind}" for kind in Figure().canvas.get_supported_filetypes())


def check_picture_name(path: str | Path) -> Path:
    """The file's path, if its ending is one that `save_figure` knows.

    Raises:
        ValueError: it is not; names those that are.
    """
    target = Path(path)
    if target.suffix.lower() not in picture_suffixes():
        raise ValueError(f"{target}: a picture's name must end with one of {', '.join(picture_suffixes())}")
    return target


def save_figure(figure: Figure, path: str | Path, dpi: float = 110.0) -> Path:
    """Write a picture; the ending of the name says in which format.

    Args:
        figure: the picture.
        path: the file; its folder is made if it is not there.
        dpi: dots per inch, where the format has dots.

    Returns:
        The file.

    Raises:
        ValueError: no such format; names those that there are.
        OSError: the file cannot be written.
    """
    target = check_picture_name(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(target, dpi=dpi)
    return target
