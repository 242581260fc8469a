"""Writes simulated scenarios as files of a data set: in several processes, and where it was interrupted it goes on."""

from __future__ import annotations

import copy
import multiprocessing
import queue
import signal
import traceback
from collections.abc import Callable, Generator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import Any

from cobevglue.simulation.layouts import Layout, Task

__all__ = ["ExportReport", "export"]

_Progress = Callable[[int, int], None]
_PATIENCE = 1.0  # between two looks at whether the workers are alive [s]
_LAST_FRAME = 30.0  # a worker that is told to stop finishes its frame within this time [s]


@dataclass(frozen=True)
class ExportReport:
    """What was done.

    Attributes:
        frames_written: frames of which something was missing.
        frames_kept: frames that were there already.
    """

    frames_written: int
    frames_kept: int


@dataclass(frozen=True)
class _Part:
    """Some frames of one scenario."""

    task: Task
    frames: tuple[int, ...]


def export(layout: Layout, tasks: Sequence[Task], *, workers: int = 1, progress: _Progress) -> ExportReport:
    """Write scenarios. The files are the same bytes with any number of workers.

    Each file appears complete or not at all, and what is there already is kept.

    Args:
        layout: the format, and where.
        tasks: the scenarios.
        workers: how many processes; with 1 it is done in this one.
        progress: called with how many frames are there and how many there will be.

    Raises:
        ValueError: the format has no room for such scenarios, or there are files of something else.
        OSError: a file cannot be written.
    """
    for task in tasks:
        layout.check(task.scenario.settings)
    for task in tasks:
        layout.claim(task)
    parts = [_Part(task, tuple(layout.missing(task))) for task in tasks]
    frames = sum(len(task.scenario) for task in tasks)
    written = sum(len(part.frames) for part in parts)
    done = frames - written
    progress(done, frames)
    shares = _shares(parts, workers)
    with closing(_work_here(layout, shares) if len(shares) < 2 else _work_in_processes(layout, shares)) as work:
        for _ in work:
            done += 1
            progress(done, frames)
    layout.finish(tasks)
    return ExportReport(written, frames - written)


def _shares(parts: Sequence[_Part], workers: int) -> list[list[_Part]]:
    """About as many frames for each worker, those of one scenario together as far as possible: its world is costly."""
    total = sum(len(part.frames) for part in parts)
    workers = max(1, min(workers, total))
    ends = [total * (worker + 1) // workers for worker in range(workers)]
    shares: list[list[_Part]] = [[] for _ in range(workers)]
    worker = given = 0
    for part in parts:
        frames = part.frames
        while frames:
            room = ends[worker] - given
            if room:
                shares[worker].append(_Part(part.task, frames[:room]))
            given += min(room, len(frames))
            frames = frames[room:]
            worker += given == ends[worker]
    return shares


def _work_here(layout: Layout, shares: Sequence[Sequence[_Part]]) -> Generator[None, None, None]:
    """Write every frame; yields after each."""
    for part in (part for share in shares for part in share):
        # A copy has computed nothing yet, and its world is forgotten when it is done.
        task = Task(part.task.number, copy.copy(part.task.scenario))
        for index in part.frames:
            layout.write(task, index)
            yield


def _work_in_processes(layout: Layout, shares: Sequence[Sequence[_Part]]) -> Generator[None, None, None]:
    """Write every frame, each share in a process of its own; yields after each."""
    context = multiprocessing.get_context("spawn")  # a fork would share SUMO, and does not get on with threads
    results: Any = context.Queue()
    stop = context.Event()
    processes = [context.Process(target=_worker, args=(layout, share, results, stop), daemon=True) for share in shares]
    for process in processes:
        process.start()
    left = sum(len(part.frames) for share in shares for part in share)
    try:
        while left:
            try:
                result = results.get(timeout=_PATIENCE)
            except queue.Empty:
                crashed = [process.exitcode for process in processes if process.exitcode]
                if crashed:
                    raise ChildProcessError(f"a worker process ended with code {crashed[0]}") from None
                continue
            if isinstance(result, Exception):
                raise result
            left -= 1
            yield
    finally:
        stop.set()
        for process in processes:
            process.join(_LAST_FRAME)
            process.terminate()
        results.cancel_join_thread()


def _worker(layout: Layout, share: Sequence[_Part], results: Any, stop: Any) -> None:
    """In a process of its own: write frames and say so after each; or say what went wrong."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all processes of a terminal; the first one stops us
    with suppress(BrokenPipeError):
        try:
            for _ in _work_here(layout, [share]):
                results.put(None)
                if stop.is_set():
                    return
        except (OSError, ValueError) as error:
            results.put(error)
        except Exception:
            results.put(RuntimeError(f"in a worker process:\n{traceback.format_exc()}"))
