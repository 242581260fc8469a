"""An interrupted study goes on, results of another are refused, and any number of workers give the same."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cobevglue.experiments.condition import Condition
from cobevglue.experiments.results import ScenarioResult
from cobevglue.experiments.runner import run_study
from cobevglue.experiments.study import StudySettings
from cobevglue.fusion.cobevglue import MaxFusion
from cobevglue.fusion.f_cooper import FCooper
from cobevglue.perception import PointPillars

from .tiny import tiny_detector, tiny_settings, tiny_tree

CONDITIONS = [
    Condition(fusion="none", aligner="given"),
    Condition(fusion="cobevglue", aligner="bevglue"),
    Condition(fusion="f-cooper", aligner="given", disturbance="noise"),
]


def numbers(results: list[ScenarioResult]) -> list[object]:
    """Everything but the times."""
    return [
        (sequence.scenario, key, index, frame.boxes.center.tolist(), frame.boxes.yaw.tolist(), frame.received)
        for sequence in results
        for key, run in sorted(sequence.conditions.items())
        for index, frame in run.frames.items()
    ]


@pytest.fixture(scope="module")
def settings(tiny: Path) -> StudySettings:
    return tiny_settings(tiny)


@pytest.fixture(scope="module")
def whole(settings: StudySettings, tmp_path_factory: pytest.TempPathFactory) -> list[ScenarioResult]:
    return run_study(settings, CONDITIONS, tmp_path_factory.mktemp("whole"))


def test_every_drive_is_run_under_every_condition_once(whole: list[ScenarioResult]) -> None:
    assert [sequence.scenario for sequence in whole] == ["a_pair", "b_three"]
    for sequence in whole:
        assert list(sequence.conditions) == [condition.key for condition in CONDITIONS]
        assert all(list(run.frames) == [0, 1, 2] for run in sequence.conditions.values())


def test_interrupted_run_is_resumed(settings: StudySettings, whole: list[ScenarioResult], tmp_path: Path) -> None:
    def interrupt(done: float, total: float) -> None:
        if done > total / 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(settings, CONDITIONS, tmp_path, progress=interrupt)
    (first,) = tmp_path.glob("*.npz")
    written = first.stat().st_mtime_ns
    progress: list[tuple[float, float]] = []
    again = run_study(settings, CONDITIONS, tmp_path, progress=lambda *now: progress.append(now))
    assert first.stat().st_mtime_ns == written
    assert numbers(again) == numbers(whole)
    assert progress[-1] == pytest.approx((39.0, 39.0))  # three frames, with perception and three conditions


def test_finished_conditions_are_not_run_again(settings: StudySettings, tmp_path: Path) -> None:
    run_study(settings, CONDITIONS[:2], tmp_path)
    progress: list[float] = []
    assert run_study(settings, CONDITIONS[:2], tmp_path, progress=lambda *now: progress.extend(now))
    assert not progress
    more = run_study(settings, CONDITIONS[1:], tmp_path, progress=lambda *now: progress.extend(now))
    assert max(progress) == 2 * 3 * (10 + 1)  # two sequences of three frames: perception, and the condition that is new
    assert list(more[0].conditions) == [condition.key for condition in CONDITIONS[1:]]
    progress.clear()
    run_study(settings, CONDITIONS, tmp_path, progress=lambda *now: progress.extend(now))
    assert not progress


def test_more_sequences_continue_in_the_same_folder(settings: StudySettings, tmp_path: Path) -> None:
    one = settings.model_copy(update={"scenarios": 1})
    assert len(run_study(one, CONDITIONS[:1], tmp_path)) == 1
    assert len(run_study(settings, CONDITIONS[:1], tmp_path)) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [({"seed": 5}, "seed 2406, not 5"), ({"frames": 2}, "frames None, not 2"), ({"min_points": 1}, "min_points 5")],
)
def test_results_of_another_study_are_not_mixed_in(
    settings: StudySettings, tmp_path: Path, change: dict[str, int], message: str
) -> None:
    one = settings.model_copy(update={"scenarios": 1})
    run_study(one, CONDITIONS[:1], tmp_path)
    with pytest.raises(ValueError, match=f"results of another study.*{message}"):
        run_study(one.model_copy(update=change), CONDITIONS[:1], tmp_path)


def test_only_changed_weights_are_run_again(tmp_path: Path) -> None:
    tiny_tree(tmp_path / "data", frames=2)
    file = tiny_detector(tmp_path)
    detector = PointPillars.load(file)
    MaxFusion(detector).save(tmp_path / "weights" / "cobevglue.safetensors")
    method = FCooper(detector)
    method.save(tmp_path / "weights" / "f-cooper.safetensors")
    settings = tiny_settings(tmp_path, scenarios=1, untrained=False, weights=str(tmp_path / "weights"))
    before = run_study(settings, CONDITIONS, tmp_path / "sequences")
    for parameter in method.head.parameters():
        parameter.data += 0.1
    method.save(tmp_path / "weights" / "f-cooper.safetensors")
    progress: list[float] = []
    after = run_study(settings, CONDITIONS, tmp_path / "sequences", progress=lambda *now: progress.extend(now))
    assert max(progress) == 2 * (10 + 1)  # two frames: perception, and the one condition of that method
    key = CONDITIONS[2].key
    assert numbers([before[0]])[0] == numbers([after[0]])[0]
    assert before[0].conditions[key].fingerprint != after[0].conditions[key].fingerprint


def test_other_detector_of_same_name_restarts_study(tmp_path: Path) -> None:
    tiny_tree(tmp_path / "data", frames=1)
    file = tiny_detector(tmp_path)
    run_study(tiny_settings(tmp_path), CONDITIONS, tmp_path / "sequences")
    detector = PointPillars.load(file)
    for parameter in detector.parameters():
        parameter.data += 0.01
    detector.save(file)
    with pytest.raises(ValueError, match=r"another study.*detector_weights"):
        run_study(tiny_settings(tmp_path), CONDITIONS, tmp_path / "sequences")


def test_damaged_files_are_named(settings: StudySettings, tmp_path: Path) -> None:
    run_study(settings.model_copy(update={"scenarios": 1}), CONDITIONS[:1], tmp_path)
    (file,) = tmp_path.glob("*.npz")
    file.write_bytes(b"no")
    with pytest.raises(ValueError, match=r"0000_a_pair\.npz: damaged"):
        run_study(settings, CONDITIONS[:1], tmp_path)
    (tmp_path / "study.json").write_text("{")
    with pytest.raises(ValueError, match=r"study\.json: damaged"):
        run_study(settings, CONDITIONS[:1], tmp_path)


def test_results_do_not_depend_on_processes(
    settings: StudySettings, whole: list[ScenarioResult], tmp_path: Path
) -> None:
    progress: list[tuple[float, float]] = []
    results = run_study(settings, CONDITIONS, tmp_path, workers=2, progress=lambda *now: progress.append(now))
    assert numbers(results) == numbers(whole)
    assert progress[-1][1] == 78.0
    assert [done for done, _ in progress] == sorted(done for done, _ in progress)


def test_worker_errors_are_reported(tiny: Path, tmp_path: Path) -> None:
    tiny_tree(tmp_path / "data", frames=2)
    (tmp_path / "data" / "test" / "b_three" / "2" / "000002.yaml").write_text("nothing: 1")
    settings = tiny_settings(tiny, root=str(tmp_path / "data"))
    with pytest.raises(ValueError, match=r"000002\.yaml: no"):
        run_study(settings, CONDITIONS[:1], tmp_path / "sequences", workers=2)


def test_a_local_ray_cluster_gives_the_same(
    settings: StudySettings, whole: list[ScenarioResult], tmp_path: Path
) -> None:
    pytest.importorskip("ray", reason="the cluster extra is not installed")
    progress: list[tuple[float, float]] = []
    results = run_study(
        settings, CONDITIONS, tmp_path, workers=2, use_ray=True, progress=lambda *now: progress.append(now)
    )
    assert numbers(results) == numbers(whole)
    assert progress[-1] == (78.0, 78.0)


@pytest.mark.parametrize(
    ("values", "error", "message"),
    [
        ({"dataset": "opv2w"}, ValueError, "no data set 'opv2w'; did you mean 'opv2v'"),
        ({"dataset": "opv2v", "root": None}, ValueError, "the data set opv2v needs a root"),
        ({"dataset": "simulated"}, ValueError, "simulated sequences have no root"),
        ({"split": "tset"}, ValueError, "no split 'tset'; did you mean 'test'"),
        ({"root": "/nowhere"}, FileNotFoundError, "no folder /nowhere"),
        ({"detector": "compakt"}, ValueError, "no pretrained detector 'compakt'; did you mean 'compact'"),
        ({"detector": "/no/such.safetensors"}, FileNotFoundError, "such.safetensors: no such file"),
        ({"untrained": False, "weights": "/nowhere"}, FileNotFoundError, "nowhere/cobevglue.safetensors: no such file"),
    ],
)
def test_bad_settings_are_refused_before_anything_is_run(
    settings: StudySettings, tmp_path: Path, values: dict[str, object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        run_study(settings.model_copy(update=values), CONDITIONS, tmp_path / "sequences")
    assert not (tmp_path / "sequences").exists()


def test_the_study_is_on_record(settings: StudySettings, tmp_path: Path) -> None:
    run_study(settings.model_copy(update={"scenarios": 1}), CONDITIONS[:1], tmp_path)
    study = json.loads((tmp_path / "study.json").read_text())
    assert (study["dataset"], study["seed"], study["split"]) == ("opv2v", 2406, "test")
