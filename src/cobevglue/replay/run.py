"""A replay from the first frame to the last, with its results in files."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from cobevglue.datasets.atomic_files import name_file_in_errors
from cobevglue.replay.replay import Replay, ReplayFrame
from cobevglue.replay.summary import Summary, frame_line

__all__ = ["LINES", "MCAP", "RERUN", "run_replay"]

MCAP, LINES, RERUN = "replay.mcap", "frames.jsonl", "replay.rrd"
"""Files of a replay, besides the page and its pictures."""
_PICTURES = 3
"""Frames that are drawn, the most telling one of each part of the recording."""


def run_replay(
    replay: Replay,
    out: Path | None = None,
    *,
    rerun: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Summary, list[Path]]:
    """Read all frames, and write the results as they come.

    Args:
        replay: that was not read yet.
        out: folder for the page, pictures, an MCAP file and a JSON document a line; made if it is not there, files of
            the same names are replaced. None to write nothing.
        rerun: write a recording for the Rerun viewer, too.
        progress: called after each frame with the number of frames so far and that of the ego's lists.

    Returns:
        What was found, and the files, the page first.

    Raises:
        ValueError: there is nothing to align, or a message is bad; names topic and message.
        OSError: a file cannot be written.
        ModuleNotFoundError: a module that writes a file is not installed.
    """
    if out is None:
        return _run(replay, None, rerun, progress)
    with name_file_in_errors(out):
        return _run(replay, out, rerun, progress)


def _run(
    replay: Replay, out: Path | None, rerun: bool, progress: Callable[[int, int], None] | None
) -> tuple[Summary, list[Path]]:
    summary = Summary()
    shown: dict[int, ReplayFrame] = {}
    total = max(replay.topics[replay.ego].count, 1)
    with ExitStack() as stack:
        writers = [] if out is None else _writers(out, replay.ego, rerun, stack)
        for frame in replay:
            summary.add(frame, replay.ego)
            for write in writers:
                write(frame)
            part = _PICTURES * frame.index // total
            if part not in shown or _informative(frame) > _informative(shown[part]):
                shown[part] = frame
            if progress is not None:
                progress(summary.frames, total)
    _check(replay, summary)
    if out is None:
        return summary, []
    from cobevglue.visualization.replay_report import write_replay_report

    files = write_replay_report(replay, summary, list(shown.values()), out)
    return summary, [*files, out / MCAP, out / LINES, *([out / RERUN] if rerun else [])]


def _writers(out: Path, ego: str, rerun: bool, stack: ExitStack) -> list[Callable[[ReplayFrame], None]]:
    """Functions that write a frame each, into files that `stack` closes."""
    from cobevglue.replay.foxglove_file import open_foxglove_file

    out.mkdir(parents=True, exist_ok=True)
    lines = stack.enter_context((out / LINES).open("w", encoding="utf-8"))

    def write_line(frame: ReplayFrame) -> None:
        lines.write(frame_line(frame) + "\n")

    writers: list[Callable[[ReplayFrame], None]] = [
        stack.enter_context(open_foxglove_file(out / MCAP, ego)).write,
        write_line,
    ]
    if rerun:
        from cobevglue.visualization.rerun import log_frame, open_recording

        stream = stack.enter_context(open_recording(out / RERUN))

        def log(frame: ReplayFrame) -> None:
            log_frame(stream, frame.seen.lists, ego, frame.seen.alignments, frame.time, frame.seen.objects)

        writers.append(log)
    return writers


def _informative(frame: ReplayFrame) -> tuple[int, int]:
    """Number of aligned agents, and of objects; the frame with most of both is shown."""
    return sum(alignment.accepted for alignment in frame.seen.alignments.values()), len(frame.seen.objects)


def _check(replay: Replay, summary: Summary) -> None:
    """A replay in which there was nothing to align is an error."""
    topic = replay.topics[replay.ego].name
    if not summary.frames:
        raise ValueError(f"{replay.recording.path}: no lists on {topic}, the topic of the ego")
    if not summary.own_objects:
        raise ValueError(f"{replay.recording.path}: no objects in any of the {summary.frames} lists on {topic}")
    if not summary.agents:
        others = ", ".join(each.name for each in list(replay.topics.values())[1:])
        raise ValueError(
            f"{replay.recording.path}: none of the {summary.frames} lists on {topic} has a list on {others} that was "
            f"received up to {replay.max_age:g} s before it (--max-age)"
        )
