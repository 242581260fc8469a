"""`cobevglue align`: relative pose from two object lists, or from two sequences of object lists."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cobevglue.cli.errors import expected_errors
from cobevglue.cli.output import print_json, print_note, print_table

if TYPE_CHECKING:
    from cobevglue.alignment import Alignment, BEVGlue
    from cobevglue.cli.object_files import FramePair

__all__ = ["align"]

_REFUSED = 3


def align(
    ego: Annotated[
        Path, typer.Argument(metavar="EGO", help="Object list of the agent in whose frame the result is, or a folder.")
    ],
    other: Annotated[Path, typer.Argument(metavar="OTHER", help="Object list of the other agent, or a folder.")],
    paper: Annotated[
        bool, typer.Option("--paper", help="Use the paper's settings instead of the robust ones.")
    ] = False,
    picture: Annotated[
        Path | None, typer.Option(help="Draw both object graphs and the result.", metavar="FILE.png")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Estimate the relative pose between two agents from commonly observed objects.

    EGO and OTHER are object lists, each in its own agent's frame: JSON files (metres and radians, {"boxes": [{"x",
    "y", "l", "w", "yaw", optional "z", "h", "score", "track_id", "label"}]}) or frames of OPV2V (.yaml), whose
    `vehicles` are transformed to the agent's own LiDAR frame; `lidar_pose` is used for nothing else.

    Two folders are sequences at 10 Hz: frames are paired by file name, and the state of the aligner is kept from frame
    to frame. The exit code is that of the last frame.

    Exit code: 0 the pose was accepted, 3 it was refused, 2 bad input.
    """
    from cobevglue.cli.object_files import read_pairs

    with expected_errors():
        if picture is not None:
            _check_picture(picture)
        pairs, notes = read_pairs(ego, other)
    for note in notes:
        print_note(note)
    glue = _glue(paper)
    with expected_errors():
        alignments = [glue.align(pair.ego, pair.other, time=pair.time) for pair in pairs]
    last = alignments[-1]
    if picture is not None:
        _draw(picture, pairs[-1], last)
    if as_json:
        from cobevglue.alignment.to_dict import alignment_to_dict

        document = alignment_to_dict(last)
        if ego.is_dir():
            document["frames"] = [
                {"name": pair.name, "time": pair.time, **alignment_to_dict(found)}
                for pair, found in zip(pairs, alignments, strict=True)
            ]
        print_json(document)
    else:
        if ego.is_dir():
            _print_frames(pairs, alignments)
        _print_verdict(pairs[-1], last)
    if not last.accepted:
        raise typer.Exit(_REFUSED)


def _glue(paper: bool) -> BEVGlue:
    from cobevglue.alignment import BEVGlue, BEVGlueConfig

    return BEVGlue(BEVGlueConfig.paper()) if paper else BEVGlue()


def _print_verdict(pair: FramePair, alignment: Alignment) -> None:
    pose = alignment.ego_SE2_other
    rows = [("verdict", "accepted" if alignment.accepted else "refused", "")]
    if alignment.reason:
        rows.append(("reason", alignment.reason, ""))
    if pose is not None:
        x, y, yaw = (math.sqrt(max(variance, 0.0)) for variance in alignment.covariance.diagonal())
        rows += [
            ("x, forward", f"{pose.x:.2f} m", f"± {x:.2f} m"),
            ("y, left", f"{pose.y:.2f} m", f"± {y:.2f} m"),
            ("yaw", f"{math.degrees(pose.yaw):.2f}°", f"± {math.degrees(yaw):.2f}°"),
        ]
    found = f"{len(alignment.matches)} of {len(pair.ego)} and {len(pair.other)}"
    rows.append(("matched objects", found, ""))
    if math.isfinite(alignment.margin):
        evidence = f"{alignment.evidence:.1f} nats, {alignment.margin:.1f} more than the best different pose"
        rows.append(("evidence", evidence, ""))
    print_table(f"Pose of the other agent in the frame of ego ({pair.name})", ("", "", "std. dev."), rows)


def _print_frames(pairs: list[FramePair], alignments: list[Alignment]) -> None:
    rows = []
    for pair, found in zip(pairs, alignments, strict=True):
        pose = found.ego_SE2_other
        numbers = ("", "", "") if pose is None else (f"{pose.x:.2f}", f"{pose.y:.2f}", f"{math.degrees(pose.yaw):.2f}")
        verdict = "accepted" if found.accepted else f"refused: {found.reason}"
        rows.append((pair.name, f"{pair.time:.1f}", *numbers, str(len(found.matches)), verdict))
    print_table("", ("frame", "time [s]", "x [m]", "y [m]", "yaw [°]", "matched", "verdict"), rows)


def _check_picture(path: Path) -> None:
    """Check the file name of the picture before the computation starts."""
    from cobevglue.visualization.style import check_picture_name

    check_picture_name(path)


def _draw(path: Path, pair: FramePair, alignment: Alignment) -> None:
    from cobevglue.visualization import draw_alignment, save_figure

    with expected_errors():
        save_figure(draw_alignment(pair.ego, pair.other, alignment), path)
    print_note(f"wrote {path}")
