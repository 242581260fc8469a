"""The report of a study: one page with figures, one Markdown file with all tables, and a CSV file for each table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cobevglue.datasets.atomic_files import atomic_write
from cobevglue.experiments.measure import Results
from cobevglue.experiments.pictures import Picture
from cobevglue.experiments.study import StudySettings
from cobevglue.experiments.table import Table
from cobevglue.experiments.tables import Experiment, Scope
from cobevglue.experiments.tables.summary import summary
from cobevglue.relative_paths import without_absolute_paths

__all__ = ["Part", "write_report"]

_TITLE = "CoBEVGlue: the paper's tables"


@dataclass(frozen=True, eq=False)
class Part:
    """One data set of a study.

    Attributes:
        settings: its data and networks.
        results: of all its conditions.
        pictures: figures by the name of the experiment that they belong to; "" for those without a table.
    """

    settings: StudySettings
    results: Results
    pictures: Mapping[str, Sequence[Picture]]


def write_report(
    folder: str | Path, experiments: Sequence[Experiment], scope: Scope, parts: Sequence[Part], about: Sequence[str]
) -> dict[str, list[Table]]:
    """Write `index.html`, `report.md` and a folder of CSV files for each data set.

    Args:
        folder: of the report; created if missing.
        experiments: to report, in order.
        scope: the conditions that were run.
        parts: the data sets.
        about: command, versions, machine and date, a line each. Absolute paths in them become relative.

    Returns:
        The tables of each data set by its name, and the summary under "".
    """
    from cobevglue.visualization.study_report import Section
    from cobevglue.visualization.study_report import write_report as write_page

    folder = Path(folder)
    tables: dict[str, list[Table]] = {"": [summary(scope, {part.settings.label: part.results for part in parts})]}
    about = [without_absolute_paths(line) for line in (*about, *(line for part in parts for line in _data(part)))]
    sections = [Section("In short", "\n\n".join(about), tables[""], _of(parts, ""))]
    markdown = [f"# {_TITLE}", "", *(f"- {line}" for line in about), "", *(t.to_markdown() for t in tables[""])]
    for experiment in experiments:
        own = {part.settings.label: experiment.tables(scope, part.results, part.settings.dataset) for part in parts}
        shown = [_titled(table, label, len(parts) > 1) for label, each in own.items() for table in each]
        sections.append(Section(experiment.title, experiment.text, shown, _of(parts, experiment.name)))
        markdown += [f"## {experiment.title}", "", experiment.text, "", *(table.to_markdown() for table in shown)]
        for label, each in own.items():
            tables.setdefault(label, []).extend(each)
    _write(folder / "report.md", "\n".join(markdown).rstrip() + "\n")
    for label, each in tables.items():
        for table in each:
            _write(folder / label.replace(" ", "_") / f"{table.name}.csv", table.to_csv())
    write_page(folder / "index.html", _TITLE, sections)
    return tables


def _data(part: Part) -> list[str]:
    """The data behind the numbers: frames, evaluated objects, skipped data."""
    results, settings = part.results, part.settings
    x_min, x_max, y_min, y_max = results.evaluation_range
    counts = (
        f"{settings.label}: {results.frame_count} frames of {len(results.sequences)} sequences, "
        f"{results.object_count} evaluated objects: with {settings.min_points} points or more of all agents together, "
        f"within x {x_min:g} to {x_max:g} m, y {y_min:g} to {y_max:g} m of the ego's LiDAR. All detections are sorted "
        "by score together (global AP)."
    )
    left_out = [f"{count} {what}" for what, count in sorted(results.left_out.items())]
    if results.frames_without_collaborators:
        left_out.append(f"{results.frames_without_collaborators} frames in which the ego is alone (used)")
    if settings.untrained:
        left_out.append("fusion methods without any training of their own: not what their papers measure")
    return [counts, *([f"{settings.label}: {'; '.join(left_out)}."] if left_out else [])]


def _of(parts: Sequence[Part], name: str) -> list[Picture]:
    """The figures of an experiment, of all data sets."""
    several = len(parts) > 1
    return [
        (f"{part.settings.label}: {caption}" if several else caption, png)
        for part in parts
        for caption, png in part.pictures.get(name, ())
    ]


def _titled(table: Table, label: str, several: bool) -> Table:
    if not several:
        return table
    return Table(table.name, f"{table.title}, {label}", table.columns, table.rows, table.notes)


def _write(path: Path, text: str) -> None:
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")
