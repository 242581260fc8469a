"""The detector as a whole: finds what it was shown, says what is wrong with its input, survives disk and ONNX."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from cobevglue.perception import CONFIGS, PointPillars, PointPillarsConfig
from cobevglue.perception.checkpoint import save_checkpoint
from cobevglue.se2 import wrap_angle

from .conftest import OBJECTS, SMALL, cloud_of

CLOUD = cloud_of(OBJECTS)


def test_trained_detector_finds_training_objects(trained: PointPillars) -> None:
    boxes = trained.detect(CLOUD)
    assert boxes.score is not None
    assert set(boxes.label if boxes.label is not None else ()) == {"vehicle"}
    good = boxes[boxes.score > 0.5]
    offset = good.center[None, :, :2] - OBJECTS[:, None, :2]
    nearest = np.hypot(offset[..., 0], offset[..., 1]).argmin(axis=1)
    assert sorted(nearest) == list(range(len(good))) == [0, 1, 2, 3]
    found = good[nearest]
    assert np.abs(found.center - OBJECTS[:, :3]).max() < 0.4
    assert np.abs(found.size / OBJECTS[:, 3:6] - 1).max() < 0.25
    assert np.abs(wrap_angle(found.yaw - OBJECTS[:, 6])).max() < 0.2, "headings, not only axes"


def test_predicted_variances_are_small_after_training(trained: PointPillars) -> None:
    boxes, variance = trained.detect_with_uncertainty(CLOUD)
    assert variance.shape == (len(boxes), 3)
    assert boxes.score is not None
    assert (np.sqrt(variance[boxes.score > 0.5]) < 0.5).all()


@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 4)), [], np.full((5, 4), np.nan), np.full((5, 4), 1e6), np.full((5, 4), 1e300)],
    ids=["none", "empty list", "NaN", "out of range", "beyond float32"],
)
def test_nothing_seen_is_no_boxes_with_scores(trained: PointPillars, points: Any) -> None:
    boxes = trained.detect(points)
    assert boxes.score is not None
    assert not (boxes.score > 0.5).any()


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((5, 3)), r"shape \(N, 4\).*got \(5, 3\)"),
        (np.zeros((5, 5)), r"got \(5, 5\)"),
        (np.zeros(4), r"got \(4,\)"),
        (np.zeros((2, 5, 4)), r"got \(2, 5, 4\)"),
        (np.zeros((5, 4), dtype=complex), "numbers, got complex128"),
        (np.zeros((5, 4), dtype=bool), "numbers, got bool"),
        ([["a", "b", "c", "d"]], "numbers, got <U1"),
        ([[1, 2, 3, 4], [1, 2]], "shape"),
        (None, "numbers, got object"),
    ],
)
def test_bad_points_are_named(detector: PointPillars, points: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        detector.detect(points)


def test_point_order_and_nan_rows_do_not_matter(trained: PointPillars) -> None:
    shuffled = np.random.default_rng(0).permutation(np.vstack([CLOUD, np.full((50, 4), np.nan)]))
    assert np.allclose(trained.detect(shuffled).bev, trained.detect(CLOUD).bev, atol=1e-3)


def test_a_batch_is_its_clouds_one_by_one(trained: PointPillars) -> None:
    clouds = [CLOUD, np.zeros((0, 4)), cloud_of(OBJECTS[:2], seed=3)]
    together = trained.detect_batch(clouds)
    assert [len(b) for b in together] == [len(trained.detect(c)) for c in clouds]
    for boxes, cloud in zip(together, clouds, strict=True):
        assert np.allclose(boxes.bev, trained.detect(cloud).bev, atol=1e-3)
    assert trained.detect_batch([]) == []


def test_shift_by_whole_cells_shifts_detections(trained: PointPillars) -> None:
    """By 8 pillars, one cell of the coarsest map. Where a point is, x and y, is left out of its description here."""
    wide = SMALL.model_copy(update={"x_range": (-25.6, 25.6), "y_range": (-25.6, 25.6)})
    detector = PointPillars(wide).eval()
    detector.load_state_dict(trained.state_dict())
    cloud = CLOUD[np.hypot(CLOUD[:, 0] - 5, CLOUD[:, 1] - 3) < 4]
    moved = cloud + np.array([3.2, -3.2, 0, 0], dtype=np.float32)
    with torch.inference_mode():
        detector.pillars.linear.weight[:, :2] = 0.0
        a, b = (detector([torch.from_numpy(c)]).logits.view(wide.head_shape) for c in (cloud, moved))
    assert torch.allclose(a[32:40, 34:44], b[28:36, 38:48], atol=1e-2), "far from the edges, whose padding is no ground"
    assert a[32:40, 34:44].std() > 0.3


def test_maps_are_halved_three_times(detector: PointPillars) -> None:
    image = detector.encode([torch.from_numpy(CLOUD)])
    assert image.shape == (1, 16, 48, 64)
    assert [tuple(m.shape[1:]) for m in detector.multiscale(image)] == [(12, 24, 32), (16, 12, 16), (24, 6, 8)]


def test_detecting_leaves_the_mode_as_it_was(detector: PointPillars) -> None:
    detector.train()
    before = {k: v.clone() for k, v in detector.state_dict().items()}
    detector.detect(CLOUD)
    assert detector.training
    assert all(torch.equal(v, before[k]) for k, v in detector.state_dict().items())


@pytest.mark.parametrize(
    ("name", "grid", "head"), [("opv2v", (200, 704), (100, 352, 2)), ("compact", (200, 352), (100, 176, 4))]
)
def test_configurations_have_the_paper_sizes(name: str, grid: Any, head: Any) -> None:
    config = CONFIGS[name]
    assert (config.rows, config.columns) == grid
    assert config.head_shape == head


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x_range": (0, 10)}, "x_range: 0.0 to 10.0 m is not a multiple of 8 pillars"),
        ({"y_range": (3.2, 0)}, "y_range"),
        ({"z_range": (1, 1)}, "z_range"),
        ({"pillar": 0}, "pillar"),
        ({"shrink_kernel": 2}, "shrink_kernel"),
        ({"pillar_channels": 24}, "pillar_channels: must be a multiple of 16, got 24; .*AVX-512"),
        ({"negative_iou": 0.9}, "negative_iou"),
        ({"anchors": ()}, "anchors"),
        ({"pillar_chanels": 3}, "did you mean 'pillar_channels'"),
        ({"detection": {"nms": 3}}, "did you mean 'nms_iou'"),
    ],
)
def test_bad_settings_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PointPillarsConfig(**changes)


@pytest.mark.parametrize(("half", "tolerance"), [(False, 1e-6), (True, 2e-2)])
def test_a_round_trip_over_disk(trained: PointPillars, tmp_path: Path, half: bool, tolerance: float) -> None:
    path = tmp_path / "d.safetensors"
    trained.save(path, {"AP@0.5": 0.9, "data": ["a", "b"]}, half=half)
    again = PointPillars.load(path)
    assert not again.training
    assert again.config == trained.config
    assert again.metadata == {"AP@0.5": 0.9, "data": ["a", "b"]}
    boxes, expected = again.detect(CLOUD), trained.detect(CLOUD)
    assert boxes.score is not None
    assert expected.score is not None
    sure = int((expected.score > 0.5).sum())
    assert np.allclose(boxes.bev[:sure], expected.bev[:sure], atol=tolerance)
    assert [p.name for p in tmp_path.iterdir()] == ["d.safetensors"]


def test_half_is_half_the_size(detector: PointPillars, tmp_path: Path) -> None:
    detector.save(tmp_path / "full")
    detector.save(tmp_path / "half", half=True)
    assert (tmp_path / "half").stat().st_size < 0.7 * (tmp_path / "full").stat().st_size


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def _text(path: Path) -> None:
    path.write_text("not weights at all")


def _foreign(path: Path) -> None:
    save_file({"a": torch.zeros(3)}, path)


def _header(**changes: str) -> Any:
    def change(path: Path) -> None:
        save_file(load_file(path), path, {**_read_header(path), **changes})

    return change


def _read_header(path: Path) -> dict[str, str]:
    raw = path.read_bytes()
    header: dict[str, str] = json.loads(raw[8 : 8 + int.from_bytes(raw[:8], "little")])["__metadata__"]
    return header


def _weights(**changes: torch.Tensor | None) -> Any:
    def change(path: Path) -> None:
        weights = {**load_file(path), **{k.replace("__", "."): v for k, v in changes.items()}}
        save_file({k: v for k, v in weights.items() if v is not None}, path, _read_header(path))

    return change


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_truncate, "damaged"),
        (_text, "damaged, or no safetensors file"),
        (_foreign, "not one of CoBEVGlue's"),
        (_header(cobevglue_format="9"), "format 9; this version of cobevglue reads format 1"),
        (_header(architecture="fusion"), "weights of 'fusion', not of 'point_pillars'"),
        (_header(config="{"), "damaged header"),
        (_header(config='{"pilar": 0.4}'), "did you mean 'pillar'"),
        (_header(config='{"x_range": [0, 1]}'), "x_range"),
        (_weights(pillars__linear__weight=None), "weight 'pillars.linear.weight' is missing"),
        (_weights(extra=torch.zeros(1)), "weight 'extra' is not part of this network"),
        (_weights(head__logits__bias=torch.zeros(3)), r"'head.logits.bias' has shape \(3,\), this network's \(4,\)"),
        (_weights(head__logits__bias=torch.full((4,), math.nan)), "'head.logits.bias' is not finite"),
    ],
)
def test_a_wrong_file_is_refused_with_the_reason(
    detector: PointPillars, tmp_path: Path, damage: Any, message: str
) -> None:
    path = tmp_path / "d.safetensors"
    detector.save(path)
    damage(path)
    with pytest.raises(ValueError, match=message) as error:
        PointPillars.load(path)
    assert str(path) in str(error.value)


def test_a_missing_file_is_missing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no\.safetensors"):
        PointPillars.load(tmp_path / "no.safetensors")


def test_a_failed_save_leaves_the_old_file(detector: PointPillars, tmp_path: Path) -> None:
    path = tmp_path / "d.safetensors"
    detector.save(path)
    before = path.read_bytes()
    with pytest.raises(TypeError):
        save_checkpoint(path, "point_pillars", {}, detector, {"bad": object()})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_pretrained_names_the_nearest(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, detector: PointPillars) -> None:
    monkeypatch.setattr("cobevglue.perception.point_pillars._WEIGHTS", tmp_path)
    with pytest.raises(ValueError, match="no pretrained detector 'small'"):
        PointPillars.pretrained("small")
    detector.save(tmp_path / "small.safetensors")
    assert PointPillars.pretrained("small").config == SMALL
    with pytest.raises(ValueError, match="did you mean 'small'"):
        PointPillars.pretrained("smal")


def test_onnx_output_equals_torch(trained: PointPillars, tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    path = tmp_path / "d.onnx"
    trained.export_onnx(path)
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    for clouds in ([CLOUD], [CLOUD, cloud_of(OBJECTS[:1])]):
        with torch.inference_mode():
            image = trained.encode([torch.from_numpy(c) for c in clouds])
            expected = trained.decode_features(trained.multiscale(image))
        values = dict(zip(expected._fields, session.run(list(expected._fields), {"image": image.numpy()}), strict=True))
        for name, value in expected._asdict().items():
            assert np.abs(values[name] - value.numpy()).max() < 1e-4, name


def test_import_without_torch_names_missing_extra() -> None:
    code = (
        "import sys\nimport cobevglue, cobevglue.tracking\n"
        "assert 'torch' not in sys.modules\nsys.modules['torch'] = None\n"
        "try:\n    import cobevglue.perception\nexcept ImportError as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "cobevglue[perception]" in done.stdout
