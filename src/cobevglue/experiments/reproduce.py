"""The whole study: run missing conditions, draw figures, write the report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from cobevglue.experiments.measure import Results
from cobevglue.experiments.models import Models
from cobevglue.experiments.pictures import (
    Picture,
    bandwidth_pictures,
    noise_pictures,
    registration_pictures,
    scene_pictures,
)
from cobevglue.experiments.report import Part, write_report
from cobevglue.experiments.runner import run_study
from cobevglue.experiments.study import StudySettings, sequence_names
from cobevglue.experiments.table import Table
from cobevglue.experiments.tables import Experiment, Scope, conditions_of

__all__ = ["reproduce"]


def reproduce(
    studies: Sequence[StudySettings],
    experiments: Sequence[Experiment],
    scope: Scope,
    folder: str | Path,
    about: Sequence[str] = (),
    *,
    workers: int = 1,
    use_ray: bool = False,
    progress: Callable[[str, float, float], None] = lambda label, done, total: None,
) -> dict[str, list[Table]]:
    """Make the paper's tables and figures.

    Args:
        studies: the data sets and networks.
        experiments: the requested tables.
        scope: range of the conditions.
        folder: of the report and of the results of each sequence, from which an interrupted run resumes.
        about: lines on the report's first page.
        workers: number of processes.
        use_ray: run on a Ray cluster; see `run_study`.
        progress: called with the name of the data, the finished work and the total work.

    Returns:
        The tables of each data set by its name, and the summary under "".

    Raises:
        ValueError: bad settings or data, see `run_study`; or two studies have the same label.
        FileNotFoundError: data or weights are missing.
        ModuleNotFoundError: a required package is not installed.
    """
    labels = [settings.label for settings in studies]
    if len(set(labels)) < len(labels):
        raise ValueError(f"the same data twice: {', '.join(labels)}")
    for settings in studies:
        sequence_names(settings)  # missing data is an error before hours of work
    conditions = conditions_of(experiments, scope)
    parts = []
    for settings in studies:
        models = Models(settings)

        def show(done: float, total: float, label: str = settings.label) -> None:
            progress(label, done, total)

        sequence_folder = Path(folder) / settings.label.replace(" ", "_") / "drives"
        runs = run_study(settings, conditions, sequence_folder, workers=workers, use_ray=use_ray, progress=show)
        results = Results(runs, models.evaluation_range, settings.min_points)
        if not results.frame_count:
            left_out = ", ".join(f"{count} {what}" for what, count in sorted(results.left_out.items()))
            raise ValueError(f"{settings.root}: {settings.label} has no frame with a cloud of a vehicle ({left_out})")
        parts.append(Part(settings, results, _pictures(settings, models, experiments, scope, results)))
    return write_report(folder, experiments, scope, parts, about)


def _pictures(
    settings: StudySettings, models: Models, experiments: Sequence[Experiment], scope: Scope, results: Results
) -> dict[str, list[Picture]]:
    """Figures by the name of the experiment."""
    names = {experiment.name for experiment in experiments}
    pictures = {"": scene_pictures(settings, models, scope)}
    if "noise" in names:
        pictures["noise"] = noise_pictures(scope, results)
    if "registration" in names:
        pictures["registration"] = registration_pictures(scope, results)
    if "bandwidth" in names:
        pictures["bandwidth"] = bandwidth_pictures(scope, results)
    return pictures
