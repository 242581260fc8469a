"""`cobevglue evaluate --task detect` with a small untrained network on a written tree, and on real clouds."""

from __future__ import annotations

import csv
import json
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cobevglue.cli import main
from cobevglue.typing import Float32Array

torch = pytest.importorskip("torch", reason="the detector needs PyTorch")


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """For a network this small more threads only wait for each other, for seconds on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A file of a small network that says something of every cloud, and nothing sensible."""
    from cobevglue.perception import DetectionConfig, PointPillars, PointPillarsConfig

    config = PointPillarsConfig(
        x_range=(-25.6, 25.6),
        y_range=(-12.8, 12.8),
        pillar=0.8,
        pillar_channels=16,
        block_layers=(1, 1, 1),
        block_channels=(4, 4, 4),
        up_channels=4,
        shrink_channels=4,
        detection=DetectionConfig(score_threshold=0.0, max_detections=20),
    )
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    PointPillars(config).save(path)
    return str(path)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory, junction_tree: Path) -> Path:
    """Twelve frames of two agents in OPV2V's format; agent 0 has clouds but for the last frame, agent 1 has none."""
    root = tmp_path_factory.mktemp("simulated") / "root"
    shutil.copytree(junction_tree, root)
    rng = np.random.default_rng(0)
    for label in sorted((root / "test").glob("*/0/*.yaml"))[:-1]:
        write_pcd(label.with_suffix(".pcd"), rng.uniform(-20.0, 20.0, (500, 3)).astype(np.float32))
    return root


def write_pcd(path: Path, xyz: Float32Array) -> None:
    """A binary cloud as OPV2V stores it, the intensity in the red byte."""
    fields = "VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    counts = f"WIDTH {len(xyz)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(xyz)}\nDATA binary\n"
    body = b"".join(struct.pack("<fffI", *row, 128 << 16) for row in xyz.tolist())
    path.write_bytes((fields + counts).encode() + body)


def evaluate(*words: str) -> int:
    return main(["evaluate", "--task", "detect", *words])


def test_json_counts_clouds_and_missing_clouds(
    simulated: Path, weights: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate("--root", str(simulated), "--weights", weights, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["frames"], report["without_cloud"]) == (11, 13)
    assert report["evaluation_range"] == [-25.6, 25.6, -12.8, 12.8]  # as far as the model looks
    assert report["overall"]["at"]["0.5"]["detections"] == 11 * 20
    assert set(report["overall"]["at"]["0.7"]["ap"]) == {"global", "frame-order"}
    assert set(report["by_range"]) == {"0-30 m", "30-50 m", "50-100 m", ">= 100 m"}


def test_clouds_without_labels_are_counted(weights: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A calibration or label file that is not there costs one cloud, not the run; DAIR-V2X has such frames."""
    (tmp_path / "vehicle-side/velodyne").mkdir(parents=True)
    identity = {"rotation": np.eye(3).tolist(), "translation": [[0], [0], [0]]}
    names = ("000001", "000002")
    index = [{"pointcloud_path": f"velodyne/{name}.pcd", "pointcloud_timestamp": name} for name in names]
    pairs = [{f"{side}_pointcloud_path": f"{name}.pcd" for side in ("vehicle", "infrastructure")} for name in names]
    files: dict[str, object] = {"vehicle-side/data_info": index, "cooperative/data_info": pairs, "test": names}
    for name in names:
        np.array([[5, 0, 0, 1]], dtype="<f4").tofile(tmp_path / f"vehicle-side/velodyne/{name}.bin")
        for calibration in ("novatel_to_world", "lidar_to_novatel"):
            files[f"vehicle-side/calib/{calibration}/{name}"] = identity
    files["vehicle-side/label/lidar/000002"] = []
    for file, content in files.items():
        path = tmp_path / f"{file}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content))
    words = ["--dataset", "dair-v2x", "--root", str(tmp_path), "--dataset-option", "labels=original"]
    assert evaluate(*words, "--weights", weights, "--json") == 0
    printed = capsys.readouterr()
    report = json.loads(printed.out)
    assert [report[key] for key in ("frames", "without_cloud", "without_labels")] == [1, 2, 1]
    assert "label/lidar/000001.json does not exist; others like it are counted" in printed.err
    (tmp_path / "vehicle-side/label/lidar/000002.json").unlink()
    assert evaluate(*words, "--weights", weights) == 2
    assert "none of the 2 clouds has labels: " in capsys.readouterr().err


def test_table_states_range_and_both_ap_dialects(
    simulated: Path, weights: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate("--root", str(simulated), "--weights", weights, "--range", "60", "40", "--min-points", "2") == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "PointPillars tiny on opv2v test: 11 clouds, |x| <= 60 m, |y| <= 40 m, >= 2 points" in out
    assert "AP@0.7 frame order @0.3" in out
    assert "13 frames of agents have no cloud" in out


def test_pictures_and_failures_are_written(
    simulated: Path, weights: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "new" / "failures.csv"
    places = ["--picture", str(tmp_path / "pictures"), "--failures", str(table)]
    assert evaluate("--root", str(simulated), "--weights", weights, *places, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert sorted(p.name for p in (tmp_path / "pictures").iterdir()) == ["000000.png", "000010.png"]  # every tenth
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    missed = [row for row in rows if row["kind"] == "missed"]
    found = round(report["overall"]["truth"] * report["overall"]["at"]["0.5"]["recall"])
    assert len(missed) == report["overall"]["truth"] - found > 0
    assert missed[0]["frame"].startswith("junction_0002/")
    assert missed[0]["agent"] == "0"
    assert int(missed[0]["points"]) >= 0


def test_a_few_clouds_of_one_scenario(simulated: Path, weights: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--root", str(simulated), "--weights", weights, "--scenario", "junction_0002", "--frames", "3", "--json"]
    assert evaluate(*words) == 0
    assert json.loads(capsys.readouterr().out)["frames"] == 3


def test_simulated_clouds_are_made_on_the_way(weights: str, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("libsumo", reason="simulated traffic needs libsumo")
    pytest.importorskip("embreex", reason="simulated clouds need embreex")
    words = ["--dataset", "simulated", "--split", "validation", "--frames", "2", "--weights", weights, "--json"]
    assert evaluate(*words) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["frames"], report["without_cloud"]) == (2, 0)
    assert report["overall"]["truth"] > 0


def test_real_clouds(culver_city: Path, weights: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--root", str(culver_city), "--split", "test_culvercity", "--frames", "2", "--weights", weights, "--json"]
    assert evaluate(*words) == 0
    assert json.loads(capsys.readouterr().out)["frames"] == 2


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--root", "{root}", "--weights", "{labels}/none.safetensors"], "none.safetensors"),  # no such file
        (["--root", "{root}", "--weights", "compcat"], "compcat"),  # no such model
        (
            ["--root", "{labels}", "--weights", "{weights}"],
            "no clouds, only the labels of 24 frames of agents; looked for {labels}",
        ),  # labels only
        (["--weights", "{weights}"], "needs --root"),  # a data set that is nowhere
        (["--dataset", "simulated", "--root", "{root}", "--weights", "{weights}"], "neither --root"),  # made up anyway
        (["--root", "{root}", "--scenario", "junction", "--weights", "{weights}"], "junction_0002"),  # no such scenario
        (["--dataset", "simulated", "--dataset-option", "labels=original", "--weights", "{weights}"], "no effect"),
        (["--root", "{root}", "--range", "0", "40", "--weights", "{weights}"], "range"),  # nothing is in this range
        (["--root", "{root}", "--perfect"], "--perfect is for --task align"),  # an option of the other task
    ],
)
def test_bad_input_is_one_line(
    simulated: Path,
    weights: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    labels = tmp_path / "labels"
    shutil.copytree(simulated, labels, ignore=shutil.ignore_patterns("*.pcd"))
    words = [word.format(root=simulated, weights=weights, labels=labels) for word in arguments]
    assert evaluate(*words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert said.format(labels=labels) in captured.err
    assert len(captured.err.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--min-points", "3"], "--min-points is for --task detect"),  # an option of the other task
        (["--range", "3", "4"], "--range is for --task detect"),  # one whose name differs inside
        (["--dataset", "v2v4real"], "needs exact poses and object ids: opv2v, v2xset"),  # a data set without
    ],
)
def test_alignment_refuses_options_of_detection(
    simulated: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    assert main(["evaluate", "--root", str(simulated), *arguments]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("dataset", "option", "message"),
    [
        ("dair-v2x", "label=original", "no option 'label'; did you mean 'labels'"),
        ("v2v4real", "left_handed", "must be KEY=VALUE"),
        ("opv2v", "labels=original", "opv2v: no option 'labels'; there are none"),
        ("dair-v2x", "labels=[", "--dataset-option labels=[: the value is not readable as YAML"),
        ("dair-v2x", "classes=car", "classes must be a list of types, like [car, bus], got 'car'"),
        ("v2v4real", "left_handed=ture", "left_handed must be true or false, got 'ture'"),  # text is true in Python
    ],
)
def test_a_bad_dataset_option_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], dataset: str, option: str, message: str
) -> None:
    (tmp_path / "test" / "scenario" / "0").mkdir(parents=True)
    words = ["evaluate", "--task", "detect", "--dataset", dataset, "--root", str(tmp_path), "--dataset-option", option]
    assert main(words) == 2
    captured = capsys.readouterr().err
    assert message in captured
    assert len(captured.splitlines()) == 1
