"""`cobevglue simulate`: what it writes reads back, the same bytes however it is written, and errors in one line."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import lru_cache
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cobevglue.cli import main
from cobevglue.datasets import DAIRV2X, OPV2V, V2V4Real
from cobevglue.simulation.export import _Part, _shares, export
from cobevglue.simulation.layouts import OPV2VLayout, Task
from cobevglue.simulation.scenario import ScenarioSettings, SimulatedScenario, simulated_scenario
from cobevglue.simulation.traffic import TrafficSettings
from cobevglue.simulation.world import World

pytest.importorskip("libsumo", reason="simulated traffic needs libsumo")
pytest.importorskip("embreex", reason="simulated clouds need embreex")

NETWORK = "t_junction_test_1"  # one whose world is quickly made
NAME = f"000_{NETWORK}"
TWO_FRAMES = ScenarioSettings(frames=2)


@pytest.fixture(autouse=True, scope="module")
def one_world() -> Iterator[None]:
    """Make each world once for all tests; it does not change when it is used."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cobevglue.simulation.scenario.World", lru_cache(World))
        yield


def simulate(out: Path, *more: str) -> int:
    words = ["--network", NETWORK, "--frames", "2", "--seed", "5", "--workers", "1"]
    return main(["simulate", str(out), *words, *more])


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames of two cars and a roadside unit in OPV2V's format; not to be written to."""
    root = tmp_path_factory.mktemp("opv2v")
    assert simulate(root, "--roadside-units", "1") == 0
    return root


def test_written_tree_is_valid_opv2v(tree: Path) -> None:
    made = simulated_scenario("test", 0, 5, ScenarioSettings(frames=2, roadside_units=1), NETWORK)
    read = OPV2V(tree, "test")[NAME]
    assert [frame.time for frame in read] == pytest.approx([0.0, 0.1])
    for agent, carrier in made.carriers.items():
        files, view = read[1].agents[str(carrier)], made.views(1)[agent]
        assert files.is_infrastructure == (carrier < 0)
        assert files.points is not None
        assert files.objects.track_id is not None
        assert view.boxes.track_id is not None
        np.testing.assert_array_equal(files.points[:, :3], view.points[:, :3])
        np.testing.assert_allclose(files.points[:, 3], view.points[:, 3], atol=0.5 / 255 + 1e-6)
        np.testing.assert_allclose(files.world_SE3_lidar, view.world_SE3_lidar, atol=1e-9)
        row, order = np.argsort(files.objects.track_id), np.argsort(view.boxes.track_id)
        np.testing.assert_array_equal(files.objects.track_id[row], view.boxes.track_id[order])
        np.testing.assert_allclose(files.objects.center[row], view.boxes.center[order], atol=1e-6)
        np.testing.assert_array_equal(files.objects.label[row], view.boxes.label[order])  # type: ignore[index]


def test_labels_have_point_counts_and_speeds(tree: Path) -> None:
    yaml = pytest.importorskip("yaml")
    scenario = tree / "test" / NAME
    car = next(folder for folder in sorted(scenario.iterdir()) if folder.name.isdigit())
    label = yaml.safe_load((car / "000002.yaml").read_text())
    assert all(vehicle["points"] >= 1 for vehicle in label["vehicles"].values())
    assert any(vehicle["speed"] > 5.0 for vehicle in label["vehicles"].values())
    assert label["true_ego_pos"][2] < label["lidar_pose"][2] - 1.5, "the vehicle is below its sensor"


def test_resumed_simulation_writes_the_same_bytes(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(layout: OPV2VLayout, task: Task, index: int) -> None:
        if index == 1:
            raise KeyboardInterrupt
        write(layout, task, index)

    write = OPV2VLayout.write
    with monkeypatch.context() as patch:
        patch.setattr(OPV2VLayout, "write", interrupted)
        assert simulate(tmp_path, "--roadside-units", "1") == 130
    assert "interrupted" in capsys.readouterr().err
    for path in sorted((tmp_path / "test" / NAME).rglob("*.*"))[::2]:
        if path.name != "simulation.json":
            path.unlink()
    assert simulate(tmp_path, "--roadside-units", "1", "--json") == 0
    captured = capsys.readouterr()
    report = json.loads(captured.out)
    assert (report["frames_written"], report["frames_kept"]) == (2, 0)
    assert report["scenarios"] == [{"name": NAME, "folder": str(tmp_path / "test" / NAME)}]
    assert "2/2" in captured.err  # the progress bar
    assert contents(tmp_path) == contents(tree)
    assert simulate(tmp_path, "--roadside-units", "1", "--json") == 0
    assert json.loads(capsys.readouterr().out)["frames_kept"] == 2


def test_workers_write_the_same_bytes(tree: Path, tmp_path: Path) -> None:
    assert simulate(tmp_path, "--roadside-units", "1", "--workers", "2") == 0
    assert contents(tmp_path) == contents(tree)


def test_worker_error_is_raised_in_parent(tmp_path: Path) -> None:
    settings = ScenarioSettings(frames=2, agents=8, traffic=TrafficSettings(vehicles=1, warm_up=0.0))
    task = Task(0, SimulatedScenario(NETWORK, 1, settings))
    with pytest.raises(ValueError, match="8 agents requested"):
        export(OPV2VLayout(tmp_path, "test"), [task], workers=2, progress=lambda done, total: None)


def test_v2v4real(tmp_path: Path) -> None:
    assert simulate(tmp_path, "--format", "v2v4real", "--labels-only") == 0
    frame = V2V4Real(tmp_path, "test")[NAME][1]
    made = simulated_scenario("test", 0, 5, TWO_FRAMES, NETWORK)[1]
    for read, agent in zip(frame.agents.values(), made.agents.values(), strict=True):
        np.testing.assert_allclose(read.world_SE3_lidar, agent.world_SE3_lidar, atol=1e-9)
        assert len(read.objects) == len(agent.objects)
        assert read.points is None
    assert len(frame.ground_truth("0")) == len(made.ground_truth("car1"))


def test_dair_v2x_in_several_batches(tmp_path: Path) -> None:
    assert simulate(tmp_path, "--format", "dair-v2x", "--frames", "1", "--scenarios", "2") == 0
    dataset = DAIRV2X(tmp_path, "test", classes={"car", "van", "truck", "bus", "motorcyclist"})
    assert dataset.scenarios == (NAME, f"001_{NETWORK}")
    frame = dataset[NAME][0]
    settings = ScenarioSettings(frames=1, agents=1, roadside_units=1)
    made = simulated_scenario("test", 0, 5, settings, NETWORK)[0]
    for read, agent in zip(frame.agents.values(), made.agents.values(), strict=True):
        np.testing.assert_allclose(read.world_SE3_lidar, agent.world_SE3_lidar, atol=1e-9)
        np.testing.assert_allclose(read.objects.center, agent.objects.center, atol=1e-9)
        np.testing.assert_array_equal(read.points[:, :3], agent.points[:, :3])  # type: ignore[index]
    truth = frame.ground_truth("vehicle")
    np.testing.assert_allclose(truth.center, made.ground_truth("car1").center, atol=1e-9)
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--network", "t_juncton_test_1"], "did you mean 't_junction_test_1'"),
        (["--network", NETWORK, "--split", "train"], "is of the split 'test', not 'train'"),
        (["--split", "tset"], "--split"),
        (["--lidar", "beams64"], "--lidar"),
        (["--format", "dair-v2x", "--agents", "2"], "agents: this format has exactly 1, got 2"),
        (["--format", "v2v4real", "--roadside-units", "1"], "roadside units: this format has exactly 0, got 1"),
    ],
)
def test_bad_input_is_one_line(words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", str(tmp_path / "out"), *words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err
    assert err.startswith("error: ")
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("more", [["--frames", "3"], ["--seed", "6"], ["--lidar", "beams16"], ["--agents", "3"]])
def test_scenarios_with_other_settings_are_not_mixed(
    more: list[str], tree: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(tree)
    assert simulate(tree, "--roadside-units", "1", *more) == 2
    assert "other settings" in capsys.readouterr().err
    assert contents(tree) == before


@pytest.mark.parametrize(
    ("kind", "there"), [("opv2v", f"test/{NAME}/file"), ("dair-v2x", "cooperative/data_info.json")]
)
def test_other_peoples_folders_are_left_alone(
    kind: str, there: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / there).parent.mkdir(parents=True)
    (tmp_path / there).write_text("")
    assert simulate(tmp_path, "--format", kind) == 2
    assert "not written by this command" in capsys.readouterr().err


def test_a_missing_extra_is_said_with_its_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def without_embreex(name: str) -> ModuleSpec | None:
        return None if name == "embreex" else ModuleSpec(name, None)

    monkeypatch.setattr("cobevglue.cli.simulate.find_spec", without_embreex)
    assert simulate(tmp_path) == 2
    assert capsys.readouterr().err == "error: simulation needs embreex: pip install 'cobevglue[simulation]'\n"


@pytest.mark.parametrize(
    ("frames", "workers", "expected"),
    [
        ([6], 2, [[(0, 3)], [(0, 3)]]),  # one drive is cut
        ([3, 3], 2, [[(0, 3)], [(1, 3)]]),  # or each gets one
        ([2, 2, 2], 2, [[(0, 2), (1, 1)], [(1, 1), (2, 2)]]),
        ([0, 1], 4, [[(1, 1)]]),  # no more workers than frames
        ([0], 4, [[]]),  # nothing to do
    ],
)
def test_frames_are_shared_out_evenly(frames: list[int], workers: int, expected: list[Any]) -> None:
    parts = [_Part(Task(i, SimulatedScenario(NETWORK)), tuple(range(count))) for i, count in enumerate(frames)]
    shares = _shares(parts, workers)
    assert [[(part.task.number, len(part.frames)) for part in share] for share in shares] == expected
    given = [(part.task.number, frame) for share in shares for part in share for frame in part.frames]
    assert given == [(i, frame) for i, count in enumerate(frames) for frame in range(count)]
