"""`cobevglue evaluate --task detect`: PointPillars on every agent's own clouds."""

from __future__ import annotations

import csv
import dataclasses
import math
import os
import statistics
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cobevglue.cli.errors import InputError, expected_errors
from cobevglue.cli.output import print_json, print_note, print_table

if TYPE_CHECKING:
    from cobevglue.evaluation.detection import BoxErrors, DetectionReport, GroupScore
    from cobevglue.evaluation.detection_data import Cloud
    from cobevglue.evaluation.detection_matching import DetectionFrame, EvaluationRange
    from cobevglue.perception import PointPillars

__all__ = ["SIMULATED", "DetectTask", "evaluate_detect"]

SIMULATED = "simulated"
"""Name of the data set of clouds that are simulated during the evaluation."""

_SIMULATED_CLOUDS = 100  # default of --frames
_PICTURE_EVERY = 10  # clouds
_NOTE_EVERY = 10.0  # seconds
_SCORE_THRESHOLD = 0.3


@dataclasses.dataclass(frozen=True)
class DetectTask:
    """Options of the evaluation.

    Attributes:
        root: of the data set; None for simulated clouds.
        dataset: name of the data set, or "simulated".
        split: name of the split.
        weights: name of shipped weights, or a .safetensors file.
        reach: |x| and |y| up to which objects are evaluated [m]; None for the detector's range.
        min_points: objects with fewer points are ignored.
        scenario: evaluate only this one; None for all.
        frames: maximum number of clouds; None for all of a data set.
        seed: of simulated worlds.
        pictures: folder for pictures, or None.
        failures: CSV file of missed objects and false detections, or None.
        options: further arguments of the data set's class.
    """

    root: Path | None
    dataset: str
    split: str
    weights: str
    reach: tuple[float, float] | None
    min_points: int
    scenario: str | None
    frames: int | None
    seed: int
    pictures: Path | None
    failures: Path | None
    options: Mapping[str, Any]

    @property
    def data(self) -> str:
        """Name of the data for titles."""
        return " ".join(part for part in (self.dataset, self.split, self.scenario) if part)


@dataclasses.dataclass
class _Counts:
    """Numbers of skipped frames of agents, and run time of each cloud [s]."""

    without_cloud: int = 0
    without_labels: int = 0
    missing_labels: str = ""  # error message of the first of them
    seconds: list[float] = dataclasses.field(default_factory=list)

    @property
    def clouds(self) -> int:
        return len(self.seconds)

    @property
    def milliseconds(self) -> float:
        """Median time per cloud [ms]."""
        return 1e3 * statistics.median(self.seconds)


def evaluate_detect(task: DetectTask, as_json: bool) -> None:
    """Run the detector on every cloud and print the evaluation; progress is printed to standard error."""
    from cobevglue.evaluation.detection import evaluate_detections

    counts = _Counts()
    with expected_errors():
        detector = _load_detector(task.weights)
        evaluation_range = _evaluation_range(task, detector)
        report = evaluate_detections(
            _detected(task, _clouds(task), detector, evaluation_range, counts),
            evaluation_range=evaluation_range,
            min_points=task.min_points,
            score_threshold=_SCORE_THRESHOLD,
        )
    if not counts.clouds and counts.without_labels:
        raise InputError(f"none of the {counts.without_labels} clouds has labels: {counts.missing_labels}")
    if not counts.clouds:
        raise InputError(
            f"{task.root}: {task.data} has no clouds, only the labels of {counts.without_cloud} frames of agents; "
            f"looked for {_cloud_location(task)}; {task.root} holds {', '.join(sorted(os.listdir(task.root))[:8])}"
        )
    if as_json:
        about = {"dataset": task.dataset, "split": task.split, "scenario": task.scenario, "weights": task.weights}
        left_out = {"without_cloud": counts.without_cloud, "without_labels": counts.without_labels}
        measured = {"median_milliseconds": counts.milliseconds, **dataclasses.asdict(report)}
        print_json({**about, **left_out, **measured})
    else:
        _print_report(task, report, counts)


def _cloud_location(task: DetectTask) -> str:
    from cobevglue.datasets import open_dataset

    assert task.root is not None  # simulated sequences have clouds
    return open_dataset(task.dataset, task.root, task.split, task.options).cloud_location


def _load_detector(weights: str) -> PointPillars:
    try:
        from cobevglue.perception import PointPillars
    except ImportError as error:
        raise InputError(str(error)) from error
    from cobevglue.torch_device import chosen_device

    return PointPillars.named(weights).to(chosen_device())


def _evaluation_range(task: DetectTask, detector: PointPillars) -> EvaluationRange:
    if task.reach is None:
        return (*detector.config.x_range, *detector.config.y_range)
    x, y = task.reach
    return -x, x, -y, y


def _clouds(task: DetectTask) -> Iterator[Cloud]:
    """The clouds of the data set, or simulated ones."""
    from cobevglue.datasets import open_dataset
    from cobevglue.evaluation.detection_data import dataset_clouds, simulated_clouds

    if task.dataset == SIMULATED:
        if task.root is not None or task.scenario is not None:
            raise InputError("--dataset simulated has neither --root nor --scenario: its clouds are simulated")
        if task.options:
            raise InputError("--dataset-option is for data sets that are read, and has no effect on simulated")
        try:
            from cobevglue.simulation.episodes import SimulatedEpisodes
        except ImportError as error:
            raise InputError(str(error)) from error
        return simulated_clouds(SimulatedEpisodes(task.split, task.seed), task.frames or _SIMULATED_CLOUDS)
    if task.root is None:
        raise InputError(f"--dataset {task.dataset} needs --root, the folder of the data set")
    dataset = open_dataset(task.dataset, task.root, task.split, task.options)
    return dataset_clouds(dataset if task.scenario is None else [dataset[task.scenario]])


def _detected(
    task: DetectTask,
    clouds: Iterable[Cloud],
    detector: PointPillars,
    evaluation_range: EvaluationRange,
    counts: _Counts,
) -> Iterator[DetectionFrame]:
    """Detections in each cloud; also writes pictures and failures, and updates `counts`."""
    from cobevglue.evaluation.detection_data import detect

    noted = time.perf_counter()
    with ExitStack() as files:
        failures = _FailureFile(task, evaluation_range, files)
        for cloud in clouds:
            if cloud.missing_labels is not None:
                if not counts.without_labels:
                    counts.missing_labels = cloud.missing_labels
                    print_note(f"a cloud is skipped: {cloud.missing_labels}; others like it are counted")
                counts.without_labels += 1
                continue
            if cloud.points is None:
                counts.without_cloud += 1
                continue
            start = time.perf_counter()
            frame = detect(cloud, detector)
            seconds = time.perf_counter() - start
            failures.write(frame)
            if task.pictures is not None and counts.clouds % _PICTURE_EVERY == 0:
                _write_picture(task.pictures, counts.clouds, frame, cloud, evaluation_range, task.min_points)
            counts.seconds.append(seconds)
            yield frame
            if time.perf_counter() - noted > _NOTE_EVERY:
                print_note(f"{counts.clouds} clouds, at {cloud.frame} {cloud.agent}")
                noted = time.perf_counter()
            if counts.clouds == task.frames:
                return


class _FailureFile:
    """CSV file of failures, created with the first frame; does nothing if the option is not set."""

    def __init__(self, task: DetectTask, evaluation_range: EvaluationRange, files: ExitStack) -> None:
        self._path, self._range, self._min_points, self._files = task.failures, evaluation_range, task.min_points, files
        self._table: csv.DictWriter[str] | None = None

    def write(self, frame: DetectionFrame) -> None:
        from cobevglue.evaluation.detection_matching import Failure, find_failures

        if self._path is None:
            return
        if self._table is None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            file = self._files.enter_context(self._path.open("w", newline="", encoding="utf-8"))
            self._table = csv.DictWriter(file, [field.name for field in dataclasses.fields(Failure)])
            self._table.writeheader()
        failures = find_failures(
            frame,
            score_threshold=_SCORE_THRESHOLD,
            evaluation_range=self._range,
            min_points=self._min_points,
        )
        for failure in failures:
            row = dataclasses.asdict(failure)
            self._table.writerow({k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()})


def _write_picture(
    folder: Path, number: int, frame: DetectionFrame, cloud: Cloud, evaluation_range: EvaluationRange, min_points: int
) -> None:
    from cobevglue.visualization import draw_detections, save_figure

    assert cloud.points is not None
    figure = draw_detections(
        frame,
        cloud.points,
        score_threshold=_SCORE_THRESHOLD,
        evaluation_range=evaluation_range,
        min_points=min_points,
    )
    save_figure(figure, folder / f"{number:06d}.png")


def _print_report(task: DetectTask, report: DetectionReport, counts: _Counts) -> None:
    """Print tables: average precision by distance, errors of detected boxes, recall by label."""
    thresholds = list(report.overall.at)
    groups = {"all": report.overall, **report.by_range}
    print_table(
        f"PointPillars {Path(task.weights).stem} on {task.data}: {report.frames} clouds, {_limits(report)}",
        (
            "distance",
            "objects",
            *(f"AP@{t:g}" for t in thresholds),
            *(f"frame order @{t:g}" for t in thresholds),
            "recall",
            "precision",
        ),
        [_score_row(name, group) for name, group in groups.items() if name == "all" or _has_any(group)],
    )
    sure = f"IoU 0.5, score >= {report.score_threshold:g}"
    if report.errors.count:
        _print_errors(report.errors, sure)
    if len(report.labels) > 1:
        print_table(
            f"Detected objects by label ({sure})",
            ("label", "objects", "recall"),
            [(name, str(one.truth), _percent(one.recall)) for name, one in report.labels.items()],
        )
    print("AP sorts all detections by score; frame order is the definition of OpenCOOD's released code.")
    print(f"Recall and precision: {sure}. {report.ignored_truth} objects were ignored.")
    none = f" {counts.without_cloud} frames of agents have no cloud." if counts.without_cloud else ""
    none += f" {counts.without_labels} clouds have no labels." if counts.without_labels else ""
    print(f"{counts.milliseconds:.0f} ms per cloud (median).{none}")


def _print_errors(errors: BoxErrors, sure: str) -> None:
    rows = [
        ("heading off by more than 90 degrees", _percent(errors.flipped)),
        ("distance of the centres", f"{errors.distance:.2f} m"),
        ("  90th percentile", f"{errors.distance_90:.2f} m"),
        ("longitudinal, lateral (positive: forward, left)", f"{errors.longitudinal:+.2f} m, {errors.lateral:+.2f} m"),
        ("radial, vertical (positive: away from the sensor, up)", f"{errors.radial:+.2f} m, {errors.vertical:+.2f} m"),
        ("yaw, without flips", f"{math.degrees(errors.yaw):.1f} degrees"),
        ("length, width, height", ", ".join(f"{v:+.2f} m" for v in (errors.length, errors.width, errors.height))),
    ]
    print_table(f"Median errors of the {errors.count} detected objects ({sure})", ("", ""), rows)


def _limits(report: DetectionReport) -> str:
    """Description of the evaluated objects."""
    assert report.evaluation_range is not None
    x_min, x_max, y_min, y_max = report.evaluation_range
    bounds = [
        f"|{axis}| <= {high:g} m" if low == -high else f"{axis} {low:g} to {high:g} m"
        for axis, low, high in (("x", x_min, x_max), ("y", y_min, y_max))
    ]
    points = [f">= {report.min_points} points"] if report.min_points else []
    return ", ".join([*bounds, *points])


def _has_any(group: GroupScore) -> bool:
    return group.truth > 0 or any(score.detections for score in group.at.values())


def _score_row(name: str, group: GroupScore) -> tuple[str, ...]:
    scores = group.at.values()
    at = group.at[0.5]
    aps = [_percent(score.ap[dialect]) for dialect in ("global", "frame-order") for score in scores]
    return (name, str(group.truth), *aps, _percent(at.recall), _percent(at.precision))


def _percent(share: float) -> str:
    return "-" if math.isnan(share) else f"{100 * share:.1f} %"
