"""Runs a study in several processes or on a Ray cluster. Each sequence has a file, so that interrupted runs resume."""

from __future__ import annotations

import json
import logging
import os
import re
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from cobevglue import __version__
from cobevglue.datasets.atomic_files import write_json
from cobevglue.experiments.condition import Condition
from cobevglue.experiments.models import Models
from cobevglue.experiments.results import ConditionResult, ScenarioResult, read_result, write_result
from cobevglue.experiments.run import PERCEPTION_COST, run_sequence
from cobevglue.experiments.study import StudySettings, open_sequence, sequence_names
from cobevglue.torch_threads import torch_threads

__all__ = ["run_study"]

_STUDY_FILE = "study.json"
_PATIENCE = 0.2  # between progress updates [s]

_Progress = Callable[[float, float], None]


@dataclass(frozen=True)
class _Job:
    """A sequence and its missing conditions."""

    settings: StudySettings
    number: int
    conditions: tuple[Condition, ...]


def run_study(
    settings: StudySettings,
    conditions: Sequence[Condition],
    folder: str | Path,
    *,
    workers: int = 1,
    use_ray: bool = False,
    progress: _Progress = lambda done, total: None,
) -> list[ScenarioResult]:
    """Run every sequence of a study under every condition; results in `folder` are reused.

    Except for times, results do not depend on the number of workers.

    Args:
        settings: the data and the networks.
        conditions: equal ones are run once.
        folder: of the result files; created if missing.
        workers: number of processes; 1 uses the current one.
        use_ray: run on the Ray cluster that RAY_ADDRESS names, or on one of `workers` processes on this machine.
        progress: called with the finished and the total work, in frames of one condition.

    Returns:
        The results of all sequences in order.

    Raises:
        ValueError: bad settings, no such data, or the folder has results of another study; says what differs.
        FileNotFoundError: the data or weights are not there.
        ModuleNotFoundError: something is not installed: the simulation, or Ray.
    """
    names = sequence_names(settings)
    models = Models(settings)
    unique = list({condition.key: condition for condition in conditions}.values())
    for condition in unique:
        models.aligner(condition)
    fingerprints = {condition.key: models.fingerprint(condition) for condition in unique}
    _claim(Path(folder), settings, models.detector_fingerprint)

    paths = [Path(folder) / f"{number:04d}_{_file_name(name)}.npz" for number, name in enumerate(names)]
    jobs = []
    for number, path in enumerate(paths):
        there = read_result(path).conditions if path.exists() else {}
        missing = [c for c in unique if c.key not in there or there[c.key].fingerprint != fingerprints[c.key]]
        if missing:
            jobs.append(_Job(settings, number, tuple(missing)))
    work = _run_here if workers == 1 and not use_ray else _run_with_ray if use_ray else _run_in_processes
    with _closing(work(jobs, workers, models, progress)) as results:
        for job, result in results:
            path = paths[job.number]
            if path.exists():
                old = read_result(path)
                result = replace(result, conditions={**old.conditions, **result.conditions})
            write_result(path, result)
    return [_only(read_result(path), fingerprints) for path in paths]


def _claim(folder: Path, settings: StudySettings, detector: str) -> None:
    """Mark the folder as this study's; refuse the folder of another study."""
    study = {"version": __version__, "detector_weights": detector, **settings.model_dump(mode="json")}
    # The number of sequences and the folder of weights do not change results; weights have fingerprints.
    for name in ("scenarios", "weights", "untrained"):
        del study[name]
    path = folder / _STUDY_FILE
    if not path.exists():
        write_json(path, study, indent=2)
        return
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
        differing = [name for name in {**study, **before} if before.get(name) != study.get(name)]
    except (ValueError, AttributeError) as error:
        raise ValueError(f"{path}: damaged: {error}") from None
    if differing:
        pairs = [f"{name} {before.get(name)!r}, not {study.get(name)!r}" for name in differing]
        raise ValueError(f"{folder}: has results of another study ({'; '.join(pairs)}); choose another folder")


def _only(result: ScenarioResult, fingerprints: Mapping[str, str]) -> ScenarioResult:
    """The result with the requested conditions only."""
    wanted: dict[str, ConditionResult] = {key: result.conditions[key] for key in fingerprints}
    return replace(result, conditions=wanted)


def _file_name(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name)


_Results = Iterator[tuple[_Job, ScenarioResult]]


def _run_here(jobs: Sequence[_Job], workers: int, models: Models, progress: _Progress) -> _Results:
    """In this process."""
    total, done = _work_of(jobs), 0.0
    with torch_threads(1):  # sums do not depend on the number of threads
        for job in jobs:
            finished = [done]

            def report(work: float, finished: list[float] = finished) -> None:
                finished[0] += work
                progress(finished[0], total)

            yield job, _run(job, models, report)
            done = finished[0]


def _run_in_processes(jobs: Sequence[_Job], workers: int, models: Models, progress: _Progress) -> _Results:
    """In several processes on this machine."""
    context = get_context("spawn")  # fork is not safe with threads
    reports: Any = context.Queue()
    stop = context.Event()
    total, done = _work_of(jobs), 0.0
    with _single_threaded(), ProcessPoolExecutor(workers, context, _start_worker, (reports, stop)) as pool:
        pending: dict[Future[ScenarioResult], _Job] = {pool.submit(_run_in_worker, job): job for job in jobs}
        try:
            while pending:
                finished, _ = wait(pending, timeout=_PATIENCE, return_when=FIRST_COMPLETED)
                done += _drained(reports)
                progress(done, total)
                for future in finished:
                    yield pending.pop(future), future.result()
            progress(total, total)
        finally:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)


def _run_with_ray(jobs: Sequence[_Job], workers: int, models: Models, progress: _Progress) -> _Results:
    """On a Ray cluster. Data sets and weights must be at the same paths on all of its machines."""
    try:
        import ray
    except ModuleNotFoundError:
        raise ModuleNotFoundError("Ray is not installed: pip install 'cobevglue[cluster]'") from None
    address = os.environ.get("RAY_ADDRESS")
    options = {"address": address} if address else {"num_cpus": workers, "include_dashboard": False}
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray.init(log_to_driver=False, logging_level=logging.ERROR, **options)
    total, done = _work_of(jobs), 0.0
    try:
        task = ray.remote(num_cpus=1)(_run_in_worker)
        pending = {task.remote(job): job for job in jobs}
        progress(done, total)
        while pending:
            (finished, *_), _ = ray.wait(list(pending), num_returns=1)
            job = pending.pop(finished)
            yield job, ray.get(finished)
            done += _work_of([job])
            progress(done, total)
    finally:
        ray.shutdown()


_worker_reports: Any = None
_worker_stop: Any = None


def _start_worker(reports: Any, stop: Any) -> None:
    """Initialise a worker process."""
    global _worker_reports, _worker_stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all processes of a terminal; the first one stops us
    _worker_reports, _worker_stop = reports, stop


def _run_in_worker(job: _Job) -> ScenarioResult:
    """Run a job in a worker process."""
    import torch

    torch.set_num_threads(1)

    def report(work: float) -> None:
        if _worker_stop is not None and _worker_stop.is_set():
            raise InterruptedError("stopped")
        if _worker_reports is not None:
            _worker_reports.put(work)

    return _run(job, Models(job.settings), report)


def _run(job: _Job, models: Models, report: Callable[[float], None]) -> ScenarioResult:
    sequence = open_sequence(job.settings, job.number)
    return run_sequence(job.settings, sequence, job.number, job.conditions, models, report)


def _work_of(jobs: Sequence[_Job]) -> float:
    """Estimated work, in frames of one condition."""
    total = 0.0
    for job in jobs:
        frames = len(open_sequence(job.settings, job.number))
        frames = min(frames, job.settings.frames or frames)
        total += frames * (PERCEPTION_COST + sum(1.0 / condition.every for condition in job.conditions))
    return total


def _drained(reports: Any) -> float:
    """Work reported by workers since the last call."""
    work = 0.0
    while not reports.empty():
        work += reports.get()
    return work


@contextmanager
def _closing(results: Any) -> Iterator[_Results]:
    try:
        yield results
    finally:
        results.close()


@contextmanager
def _single_threaded() -> Iterator[None]:
    """Processes started in this context use one thread each."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
