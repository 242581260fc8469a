"""Every table and figure of the report, from a study that is run in no time."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import pytest

from cobevglue.experiments import paper
from cobevglue.experiments.measure import Results
from cobevglue.experiments.models import Models
from cobevglue.experiments.reproduce import reproduce
from cobevglue.experiments.runner import run_study
from cobevglue.experiments.table import Table
from cobevglue.experiments.tables import EXPERIMENTS, FULL, QUICK, Scope, conditions_of, experiments_named
from cobevglue.experiments.tables.scope import as_is, attacked, method_title
from cobevglue.experiments.tables.summary import summary
from cobevglue.fusion import FUSION_METHODS, Compression

from .tiny import tiny_settings, write_agent

ALL = list(EXPERIMENTS.values())


@pytest.fixture(scope="module")
def results(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Results:
    """All that the quick tables need, of one sequence."""
    settings = tiny_settings(tiny, scenarios=1, frames=2)
    runs = run_study(settings, conditions_of(ALL, QUICK), tmp_path_factory.mktemp("sequences"))
    return Results(runs, Models(settings).evaluation_range, settings.min_points)


def table(results: Results, experiment: str, name: str, dataset: str = "simulated") -> Table:
    return next(t for t in EXPERIMENTS[experiment].tables(QUICK, results, dataset) if t.name == name)


def column(table: Table, name: str) -> dict[str, object]:
    """The cells of a column by those of the first."""
    return {str(row[0]): row[list(table.columns).index(name)] for row in table.rows}


@pytest.mark.parametrize("experiment", ALL, ids=lambda experiment: experiment.name)
def test_table_uses_only_its_conditions(results: Results, experiment: object) -> None:
    from dataclasses import replace

    from cobevglue.experiments.tables import Experiment

    assert isinstance(experiment, Experiment)
    wanted = {condition.key for condition in experiment.conditions(QUICK)}
    sequences = [
        replace(sequence, conditions={key: run for key, run in sequence.conditions.items() if key in wanted})
        for sequence in results.sequences
    ]
    alone = Results(sequences, results.evaluation_range, results.min_points)
    tables = experiment.tables(QUICK, alone, "simulated")
    assert tables
    assert all(table.rows and table.to_markdown() and table.to_csv() for table in tables)


def test_table_1_has_every_method_and_reference(results: Results) -> None:
    made = table(results, "noise", "noise_ap0.5")
    titles = [row[0] for row in made.rows]
    assert titles[: len(FUSION_METHODS)] == [method_title(name) for name in FUSION_METHODS]
    assert titles[len(FUSION_METHODS) :] == ["Given pose, CoBEVGlue's fusion", "True pose, CoBEVGlue's fusion"]
    assert list(made.columns) == ["method", "poses from", "0.0/0.0", "2.5/2.5"]
    clean, noisy = column(made, "0.0/0.0"), column(made, "2.5/2.5")
    for flat in ("No collaboration", "CoBEVGlue", "True pose, CoBEVGlue's fusion"):
        assert clean[flat] == noisy[flat]
    assert clean["Given pose, CoBEVGlue's fusion"] == clean["True pose, CoBEVGlue's fusion"]


def test_cobevglue_is_really_run_at_every_level() -> None:
    conditions = {condition.key for condition in EXPERIMENTS["noise"].conditions(FULL)}
    assert all(as_is("cobevglue", level).key in conditions for level in (0.0, 0.5, 1.5, 2.5))


@pytest.mark.parametrize("dataset", ["opv2v", "dair-v2x", "v2v4real"])
def test_paper_figures_appear_on_its_data_sets(results: Results, dataset: str) -> None:
    made = table(results, "noise", "noise_ap0.7", dataset)
    assert list(made.columns) == ["method", "poses from", "0.0/0.0", "paper 0.0/0.0", "2.5/2.5", "paper 2.5/2.5"]
    beside = {row[0]: (row[3], row[5]) for row in made.rows}
    for name, published in paper.NOISE[dataset].items():
        if name in FUSION_METHODS:
            assert beside[method_title(name)] == (published[0.7][0], published[0.7][3])
    assert beside["Late fusion"] == (None, None)
    assert beside["True pose, CoBEVGlue's fusion"] == (None, None)


def test_table_2_is_without_and_with_bevglue(results: Results) -> None:
    made = table(results, "attack", "attack")
    titles = [row[0] for row in made.rows]
    assert titles == [method_title(n) for n in FUSION_METHODS if n != "none"] + ["No collaboration"]
    assert column(made, "AP@0.5 with")["F-Cooper"] == results.ap(attacked("f-cooper", "bevglue"), 0.5)
    assert column(made, "AP@0.7 without")["F-Cooper"] == results.ap(attacked("f-cooper"), 0.7)
    added = column(made, "added bytes [%]")["F-Cooper"]
    condition = attacked("f-cooper", "bevglue")
    assert added == pytest.approx(100 * results.alignment_bytes(condition) / results.payload_bytes(condition))


def test_registration_runs_every_aligner_and_budget() -> None:
    conditions = EXPERIMENTS["registration"].conditions(FULL)
    for aligner in FULL.registrations:
        run = [condition for condition in conditions if condition.aligner == aligner]
        assert {condition.aligner_options["budget_bytes"] for condition in run} == set(FULL.budgets)
        assert all(condition.every == FULL.registration_every for condition in run)
    assert "given" not in FULL.registrations
    assert "bevglue" not in FULL.registrations


def test_the_ablation_switches_off_geometry_and_tracking(results: Results) -> None:
    made = table(results, "ablation", "ablation", "opv2v")
    marks = [tuple(row[:3]) for row in made.rows]
    assert marks[:3] == [("as printed", "no", "no"), ("as printed", "yes", "no"), ("as printed", "yes", "yes")]
    assert marks[3:5] == [("ours", "yes", "no"), ("ours", "yes", "yes")]
    assert [row[list(made.columns).index("AP@0.5") + 1] for row in made.rows[:3]] == [0.7781, 0.9545, 0.9581]


def test_each_disturbance_is_a_row(results: Results) -> None:
    made = table(results, "disturbances", "disturbances_ap0.5")
    assert len(made.rows) == 9
    ours = column(made, "CoBEVGlue")
    for harmless in ("poses replayed from 1 s ago", "poses off by 3 m, −2 m, 3°"):
        assert ours[harmless] == ours["nothing"]


def test_poses_are_counted_by_collaborator(results: Results) -> None:
    made = table(results, "pose", "poses")
    assert {(row[0], row[1]) for row in made.rows} >= {("BEVGlue", "0.0/0.0"), ("given pose", "2.5/2.5")}
    assert all(row[2] == 2 for row in made.rows)  # two frames with one collaborator
    exact = next(row for row in made.rows if row[:2] == ["given pose", "0.0/0.0"])
    assert exact[3:8] == [0.0, 1.0, 1.0, 1.0, 0.0]


def test_communication_equals_encoded_bytes(results: Results) -> None:
    made = table(results, "communication", "communication")
    sent = column(made, "bytes")
    assert sent["CoBEVGlue"] == results.payload_bytes(as_is("cobevglue"))
    assert isinstance(sent["CoBEVGlue"], float)
    assert column(made, "log2")["CoBEVGlue"] == pytest.approx(math.log2(sent["CoBEVGlue"]))
    assert column(made, "bytes for alignment")["Late fusion"] == 153.0  # a pose in float64


def test_bandwidth_compresses_every_method_with_features(results: Results) -> None:
    made = table(results, "bandwidth", "bandwidth")
    assert [row[0] for row in made.rows if row[2] is None] == [method_title(name) for name in FUSION_METHODS]
    compressed = {row[0]: row for row in made.rows if row[2] is not None}
    assert set(compressed) == {method_title(name) for name in FUSION_METHODS if name not in ("none", "late", "early")}
    assert compressed["CoBEVGlue"][2:4] == [3, 0.05]
    assert compressed["Where2comm"][2:4] == [3, 1.0]
    condition = as_is("cobevglue", compression=Compression(bits=3, cells=0.05))
    every = QUICK.bandwidth_every
    sent = results.payload_bytes(condition, every) + results.alignment_bytes(condition, every)
    assert compressed["CoBEVGlue"][4] == sent < 0.3 * results.payload_bytes(as_is("cobevglue"))


def test_summary_omits_tables_not_run(results: Results) -> None:
    made = summary(QUICK, {"here": results, "there": results})
    assert list(made.columns) == ["", "here", "there"]
    assert column(made, "here") == column(made, "there")
    assert column(made, "here")["frames"] == 2
    assert any("methods below" in str(row[0]) for row in made.rows)
    only = Results(
        [
            type(d)(d.scenario, d.ego, d.truth, d.left_out, {as_is("none").key: d.conditions[as_is("none").key]})
            for d in results.sequences
        ],
        results.evaluation_range,
        results.min_points,
    )
    assert [row[0] for row in summary(QUICK, {"here": only}).rows] == [
        "frames",
        "evaluated objects",
        "AP@0.5, no collaboration",
        "AP@0.7, no collaboration",
    ]


def test_an_unknown_table_is_named_with_the_nearest() -> None:
    with pytest.raises(ValueError, match="no table 'nois'; did you mean 'noise'"):
        experiments_named(["attack", "nois"])
    assert [experiment.name for experiment in experiments_named(["time", "noise"])] == ["noise", "time"]


def test_conditions_are_unique_and_study_size_bounded() -> None:
    conditions = conditions_of(ALL, FULL)
    assert len({condition.key for condition in conditions}) == len(conditions)
    work = sum(1 / condition.every for condition in conditions)
    assert work < 7.5 * len(FUSION_METHODS) + 30  # in runs of one condition over all frames: what takes the time


def test_the_report_is_written(tiny: Path, tmp_path: Path) -> None:
    write_agent(tmp_path / "other" / "test" / "sequence", 1, range(2))
    studies = [
        tiny_settings(tiny, scenarios=1, frames=2),
        tiny_settings(tiny, dataset="v2xset", root=str(tmp_path / "other")),
    ]
    experiments = experiments_named(["noise", "communication"])
    small = Scope(levels=(0.0, 2.5))
    made = reproduce(studies, experiments, small, tmp_path / "report", ["Command: test"])
    assert list(made) == ["", "opv2v test", "v2xset test"]
    markdown = (tmp_path / "report" / "report.md").read_text()
    assert "Command: test" in markdown
    assert "1 frames in which the ego is alone" not in markdown
    assert "2 frames in which the ego is alone" in markdown
    assert "### AP@0.5 under localisation noise, v2xset test" in markdown
    page = (tmp_path / "report" / "index.html").read_text()
    assert page.count("data:image/png;base64,") >= 4
    rows = list(csv.reader((tmp_path / "report" / "opv2v_test" / "noise_ap0.7.csv").read_text().splitlines()))
    assert rows[0][:3] == ["method", "poses from", "0.0/0.0"]
    assert len(rows) == 1 + len(FUSION_METHODS) + 2


def test_data_without_any_cloud_is_refused(tiny: Path, tmp_path: Path) -> None:
    write_agent(tmp_path / "data" / "test" / "sequence", 1, range(2), with_clouds=False)
    settings = tiny_settings(tiny, root=str(tmp_path / "data"))
    with pytest.raises(ValueError, match=r"no frame with a cloud of a vehicle .2 agents without a cloud, 2 frames"):
        reproduce([settings], experiments_named(["communication"]), QUICK, tmp_path / "report")


def test_the_same_data_twice_is_refused(tiny: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="the same data twice"):
        reproduce([tiny_settings(tiny)] * 2, experiments_named(["noise"]), QUICK, tmp_path / "report")


def test_paper_has_its_own_claims() -> None:
    # Section 6.2: CoBEVGlue is best at every noise above none, on all three data sets, at AP@0.5.
    for methods in paper.NOISE.values():
        for name, published in methods.items():
            assert all(len(values) == 4 for values in published.values())
            if name != "cobevglue-features":
                assert all(value < methods["cobevglue-features"][0.5][0] for value in published[0.5][2:])
