"""`cobevglue replay`: the object lists of a recording, aligned and fused."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cobevglue.cli.errors import InputError, expected_errors
from cobevglue.cli.output import print_json, print_note, print_table

if TYPE_CHECKING:
    from cobevglue.boxes import Boxes
    from cobevglue.replay import Replay
    from cobevglue.replay.summary import Summary

__all__ = ["replay"]

_REFUSED = 3
_NOTE_EVERY = 500  # frames


def replay(
    recording: Annotated[
        Path, typer.Argument(metavar="RECORDING", help="An .mcap, .db3 or .bag file, or the folder of a ROS 2 bag.")
    ],
    ego: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="Topic of the agent in whose frame the result is.")
    ] = None,
    other: Annotated[
        list[str] | None, typer.Option(metavar="TOPIC", help="Topic of another agent; repeat it for more.")
    ] = None,
    body: Annotated[
        list[str] | None,
        typer.Option(
            metavar="AGENT=L,W[,X[,Y]]",
            help="Length and width of an agent's own vehicle, and where its middle is in the frame of its lists [m].",
        ),
    ] = None,
    frame: Annotated[
        list[str] | None,
        typer.Option(
            metavar="AGENT=FRAME",
            help="Frame into which recorded transforms (tf) bring an agent's lists; default: base_link for those in a "
            "map, the others are left as they are.",
        ),
    ] = None,
    max_age: Annotated[
        float, typer.Option(metavar="SECONDS", help="Lists received so much earlier than the ego's are not used.")
    ] = 0.5,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the page, pictures, an MCAP file for Foxglove and lines of JSON."),
    ] = None,
    rerun: Annotated[bool, typer.Option("--rerun", help="Write a recording for the Rerun viewer, too.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Find where recorded agents are relative to each other, and fuse their objects. ROS is not needed.

    Each agent has a topic: vision_msgs/Detection3DArray, DetectedObjects or TrackedObjects of Autoware,
    sensor_msgs/PointCloud2 (through our detector), or CPMs as bytes. Each list of the ego is aligned with the newest
    list of every other agent that was received before it. Topics are guessed if they are left out.

    Exit code: 0 done, 3 no pose was accepted in any frame, 2 bad input.

    Needs: pip install 'cobevglue[ros]'
    """
    if find_spec("rosbags") is None:
        raise InputError("replay needs rosbags: pip install 'cobevglue[ros]'")
    from cobevglue.recordings import open_recording
    from cobevglue.replay import Replay
    from cobevglue.replay.run import run_replay

    if rerun and out is None:
        raise InputError("--rerun: needs a folder (--out)")
    with expected_errors(), _missing_modules(), open_recording(recording) as opened:
        made = Replay(opened, ego, other or (), max_age=max_age)
        made.bodies = _bodies(body or [], made)
        made.frames = dict(_of_agent("--frame", text, made) for text in frame or [])
        for agent, topic in made.topics.items():
            print_note(f"{'ego' if agent == made.ego else 'other'}: {agent} ({topic.name}, {topic.count} messages)")
        print_note("aligning (the first run compiles for half a minute) …")
        summary, files = run_replay(made, out, rerun=rerun, progress=_note)
    for stream in made.streams.values():
        for problem in stream.problems():
            print_note(problem)
    if as_json:
        print_json({**summary.to_dict(made), "files": [str(file) for file in files]})
    else:
        _print(summary, files)
    if not summary.accepted:
        raise typer.Exit(_REFUSED)


def _note(done: int, total: int) -> None:
    if done % _NOTE_EVERY == 0:
        print_note(f"{done} of {total} frames")


def _bodies(given: list[str], made: Replay) -> dict[str, Boxes]:
    """Own vehicles from texts such as car1=4.5,1.9."""
    from cobevglue.cli.body_option import parse_body

    bodies = {}
    for text in given:
        agent, numbers = _of_agent("--body", text, made)
        try:
            bodies[agent] = parse_body(numbers)
        except ValueError:
            raise InputError(f"--body: must be AGENT=LENGTH,WIDTH or AGENT=LENGTH,WIDTH,X,Y, got {text!r}") from None
    return bodies


def _of_agent(option: str, text: str, made: Replay) -> tuple[str, str]:
    """Agent and value of an option AGENT=VALUE."""
    from cobevglue.datasets.frame import did_you_mean

    agent, _, value = text.partition("=")
    if agent not in made.topics:
        raise InputError(f"{option}: there is no agent {did_you_mean(agent, made.topics)}")
    return agent, value


def _print(summary: Summary, files: list[Path]) -> None:
    from cobevglue.visualization.replay_report import agent_table

    header, rows = agent_table(summary)
    own, fused = (count / summary.frames for count in (summary.own_objects, summary.fused_objects))
    title = f"{summary.frames} frames of the ego: {own:.1f} objects alone, {fused:.1f} with the others"
    print_table(title, header, rows)
    if summary.alone:
        print(f"{summary.alone} frames have no recent list of another agent.")
    if files:
        print(f"Open {files[0]} to see it; {files[3]} is for Foxglove and Lichtblick.")


@contextmanager
def _missing_modules() -> Iterator[None]:
    """A missing optional dependency as an error of one line, which names the extra."""
    try:
        yield
    except ModuleNotFoundError as error:
        if "pip install" not in str(error):
            raise
        raise InputError(str(error)) from error
