"""Export of simulated scenarios to the files of a data set, in several processes; resumes after an interruption."""

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
_POLL_INTERVAL = 1.0  # between checks that the workers are alive [s]
_STOP_TIMEOUT = 30.0  # for a worker to finish its frame before it is terminated [s]


@dataclass(frozen=True)
class ExportReport:
    """Result of an export.

    Attributes:
        frames_written: number of frames with missing files, which were written.
        frames_kept: number of frames that were already complete.
    """

    frames_written: int
    frames_kept: int


@dataclass(frozen=True)
class _Part:
    """Some frames of one scenario."""

    task: Task
    frames: tuple[int, ...]


def export(layout: Layout, tasks: Sequence[Task], *, workers: int = 1, progress: _Progress) -> ExportReport:
    """Write scenarios. The files are byte-identical for any number of workers.

    Files are written atomically; existing ones are kept.

    Args:
        layout: format and folder of the data set.
        tasks: the scenarios.
        workers: number of processes; 1 runs in the current one.
        progress: called with the number of complete frames and the total.

    Raises:
        ValueError: the format does not support such scenarios, or the folder contains other files.
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
    with closing(_write_locally(layout, shares) if len(shares) < 2 else _write_in_processes(layout, shares)) as work:
        for _ in work:
            done += 1
            progress(done, frames)
    layout.finish(tasks)
    return ExportReport(written, frames - written)


def _shares(parts: Sequence[_Part], workers: int) -> list[list[_Part]]:
    """Split the frames evenly over the workers, with few splits within a scenario: building its world is expensive."""
    total = sum(len(part.frames) for part in parts)
    workers = max(1, min(workers, total))
    ends = [total * (worker + 1) // workers for worker in range(workers)]
    shares: list[list[_Part]] = [[] for _ in range(workers)]
    worker = assigned = 0
    for part in parts:
        frames = part.frames
        while frames:
            room = ends[worker] - assigned
            if room:
                shares[worker].append(_Part(part.task, frames[:room]))
            assigned += min(room, len(frames))
            frames = frames[room:]
            worker += assigned == ends[worker]
    return shares


def _write_locally(layout: Layout, shares: Sequence[Sequence[_Part]]) -> Generator[None, None, None]:
    """Write every frame; yields after each."""
    for part in (part for share in shares for part in share):
        # A fresh copy: its cached world is freed with it.
        task = Task(part.task.number, copy.copy(part.task.scenario))
        for index in part.frames:
            layout.write(task, index)
            yield


def _write_in_processes(layout: Layout, shares: Sequence[Sequence[_Part]]) -> Generator[None, None, None]:
    """Write every frame, each share in its own process; yields after each."""
    context = multiprocessing.get_context("spawn")  # fork would share SUMO's state and is unsafe with threads
    results: Any = context.Queue()
    stop = context.Event()
    processes = [context.Process(target=_worker, args=(layout, share, results, stop), daemon=True) for share in shares]
    for process in processes:
        process.start()
    left = sum(len(part.frames) for share in shares for part in share)
    try:
        while left:
            try:
                result = results.get(timeout=_POLL_INTERVAL)
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
            process.join(_STOP_TIMEOUT)
            process.terminate()
        results.cancel_join_thread()


def _worker(layout: Layout, share: Sequence[_Part], results: Any, stop: Any) -> None:
    """Write frames in a worker process; put None after each frame, or the exception, into `results`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent stops the workers
    with suppress(BrokenPipeError):
        try:
            for _ in _write_locally(layout, [share]):
                results.put(None)
                if stop.is_set():
                    return
        except (OSError, ValueError) as error:
            results.put(error)
        except Exception:
            results.put(RuntimeError(f"in a worker process:\n{traceback.format_exc()}"))
