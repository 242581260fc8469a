"""Tracking text files: a line of each kind by hand, what broken lines say, and conventions checked on real files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cobevglue import Boxes
from cobevglue.datasets.tracking_text import (
    count_frames,
    read_kitti_detections,
    read_kitti_labels,
    read_v2v4real_detections,
    read_v2v4real_labels,
)
from cobevglue.typing import FloatArray

Reader = Callable[[Path], list[Boxes]]

V2V_DETECTION = "0,2,0,0,0,0,0.55,1.7,1.9,4.3,-20.5,-1.2,3.0,0.25,0.000000"
V2V_LABEL = "0 17 Car 0 0 0 0 0 0 0 1.7 1.9 4.3 -20.5 -1.2 3.0 0.25"
KITTI_DETECTION = "0,2,786.7,180.1,1241.0,374.0,12.2,1.5,1.7,4.4,2.9,1.6,6.4,-1.5,-2.0"
KITTI_LABEL = "0 17 Car 0 1 2.6 286.7 187.1 527.9 292.5 1.5 1.7 4.4 2.9 1.6 6.4 -1.5"
READERS = [
    (read_v2v4real_detections, V2V_DETECTION),
    (read_v2v4real_labels, V2V_LABEL),
    (read_kitti_detections, KITTI_DETECTION),
    (read_kitti_labels, KITTI_LABEL),
]


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_v2v4real_detection_by_hand(tmp_path: Path) -> None:
    (boxes,) = read_v2v4real_detections(write(tmp_path / "0000.txt", V2V_DETECTION))
    np.testing.assert_allclose(boxes.center, [[-20.5, 3.0, -1.2]])  # the file has x, z, y
    np.testing.assert_allclose(boxes.size, [[4.3, 1.9, 1.7]])  # and h, w, l
    np.testing.assert_allclose(boxes.yaw, [0.25])
    np.testing.assert_array_equal(boxes.score, [0.55])
    assert boxes.track_id is None
    np.testing.assert_array_equal(boxes.label, ["car"])


def test_v2v4real_label_by_hand_and_mirrored(tmp_path: Path) -> None:
    path = write(tmp_path / "0000.txt", V2V_LABEL)
    (boxes,) = read_v2v4real_labels(path)
    np.testing.assert_allclose(boxes.center, [[-20.5, 3.0, -1.2]])
    np.testing.assert_array_equal(boxes.track_id, [17])
    assert boxes.score is None
    (turned,) = read_v2v4real_labels(path, left_handed=True)
    np.testing.assert_allclose(turned.center, [[-20.5, -3.0, -1.2]])
    np.testing.assert_allclose(turned.yaw, [-0.25])


@pytest.mark.parametrize(
    ("rotation_y", "yaw", "why"),
    [
        (0.0, -np.pi / 2, "heading to the camera's x, which is to the right"),
        (-np.pi / 2, 0.0, "heading away along the view"),
        (np.pi / 2, -np.pi, "heading to the camera"),
        (-np.pi, np.pi / 2, "heading to the left"),
    ],
)
def test_a_kitti_box_by_hand(tmp_path: Path, rotation_y: float, yaw: float, why: str) -> None:
    words = KITTI_LABEL.split()
    words[-1] = str(rotation_y)
    (boxes,) = read_kitti_labels(write(tmp_path / "0001.txt", " ".join(words)))
    np.testing.assert_allclose(boxes.center, [[6.4, -2.9, -1.6 + 0.75]])  # z forward, x right, the bottom 1.6 below
    np.testing.assert_allclose(boxes.size, [[4.4, 1.7, 1.5]])
    np.testing.assert_allclose(boxes.yaw, [yaw], atol=1e-12, err_msg=why)


def test_kitti_detection_equals_label_format(tmp_path: Path) -> None:
    (detected,) = read_kitti_detections(write(tmp_path / "a.txt", KITTI_DETECTION))
    (labelled,) = read_kitti_labels(write(tmp_path / "b.txt", KITTI_LABEL))
    np.testing.assert_allclose(detected.center, labelled.center)
    np.testing.assert_allclose(detected.yaw, labelled.yaw)
    np.testing.assert_array_equal(detected.score, [12.2])  # not a probability


def test_only_the_classes_asked_for(tmp_path: Path) -> None:
    dont_care = "0 -1 DontCare -1 -1 -10 356 195 374 216 -1000 -1000 -1000 -10 -1 -1 -1"
    van = KITTI_LABEL.replace(" 17 Car", " 18 Van")
    path = write(tmp_path / "a.txt", dont_care, KITTI_LABEL, van, dont_care, van.replace("0 18", "2 18"))
    assert [len(boxes) for boxes in read_kitti_labels(path)] == [1, 0, 0]  # as many frames as the file has
    both = read_kitti_labels(path, classes=("Car", "van"))
    np.testing.assert_array_equal(both[0].label, ["car", "van"])
    np.testing.assert_array_equal(both[0].track_id, [17, 18])


@pytest.mark.parametrize(("reader", "line"), READERS)
def test_frames_without_boxes_are_empty(tmp_path: Path, reader: Reader, line: str) -> None:
    path = write(tmp_path / "a.txt", line.replace("0", "1", 1), "", line.replace("0", "4", 1))
    assert [len(boxes) for boxes in reader(path)] == [0, 1, 0, 0, 1]
    assert [len(boxes) for boxes in reader(path, frame_count=6)] == [0, 1, 0, 0, 1, 0]  # type: ignore[call-arg]
    assert count_frames(path, write(tmp_path / "b.txt", line.replace("0", "7", 1))) == 8
    with pytest.raises(ValueError, match=r"a\.txt:3: frame 4, but there are 3 frames"):
        reader(path, frame_count=3)  # type: ignore[call-arg]


def test_an_empty_file_has_no_frames(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("")
    assert read_v2v4real_detections(tmp_path / "a.txt") == []
    assert count_frames(tmp_path / "a.txt") == 0
    assert len(read_v2v4real_detections(tmp_path / "a.txt", frame_count=2)) == 2


@pytest.mark.parametrize(("reader", "line"), READERS)
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("1.7", "wide", "could not convert"),
        ("1.7", "nan", "not finite"),
        ("1.7", "-1.7", "must be > 0|>= 0"),
        ("1.7", "1.7 3", "values, got"),
        ("0", "first", "starts with a frame number"),
        ("0", "-1", "starts with a frame number"),
    ],
)
def test_a_bad_line_names_file_and_line(
    tmp_path: Path, reader: Reader, line: str, old: str, new: str, message: str
) -> None:
    path = write(tmp_path / "0003.txt", line, "", line.replace(old, new, 1).replace(" 17 ", " 18 "))
    with pytest.raises(ValueError, match=message) as error:
        reader(path)
    assert str(error.value).startswith(f"{path}:3: ")


@pytest.mark.parametrize("reader", [read_v2v4real_detections, read_kitti_detections])
def test_an_unknown_type_of_detection_is_named(tmp_path: Path, reader: Reader) -> None:
    with pytest.raises(ValueError, match=r"a\.txt:1: unknown type 9"):
        reader(write(tmp_path / "a.txt", V2V_DETECTION.replace("0,2", "0,9")))


@pytest.mark.parametrize(("reader", "line"), [READERS[1], READERS[3]])
def test_repeated_track_in_frame_names_both_lines(tmp_path: Path, reader: Reader, line: str) -> None:
    with pytest.raises(ValueError, match=r"a\.txt:3: track 17 is in frame 0 already, line 1"):
        reader(write(tmp_path / "a.txt", line, line.replace("17", "18"), line))
    with pytest.raises(ValueError, match=r"a\.txt:1: the track id must be an integer, got '17\.5'"):
        reader(write(tmp_path / "a.txt", line.replace(" 17 ", " 17.5 ")))


def test_missing_and_binary_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"a\.txt does not exist"):
        read_kitti_labels(tmp_path / "a.txt")
    (tmp_path / "b.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match=r"b\.txt: not a text file"):
        read_kitti_labels(tmp_path / "b.txt")


# ---- real files ----


def tracks(frames: list[Boxes]) -> dict[int, FloatArray]:
    """(T, 4) frame, x, y, yaw of each track."""
    rows: dict[int, list[list[float]]] = {}
    for frame, boxes in enumerate(frames):
        if boxes.track_id is not None:
            for track_id, center, yaw in zip(boxes.track_id.tolist(), boxes.center, boxes.yaw, strict=True):
                rows.setdefault(track_id, []).append([frame, center[0], center[1], yaw])
    return {track_id: np.array(row) for track_id, row in rows.items()}


def test_every_real_file_is_read(real_data: Path) -> None:
    frames = 0
    for path in sorted((real_data / "v2v4real_detections").glob("*/labels/*.txt")):
        sides = [path.parent.parent / side / path.name for side in ("ego", "other")]
        count = count_frames(path, *sides)
        lengths = {len(read_v2v4real_detections(side, count)) for side in sides} | {
            len(read_v2v4real_labels(path, count))
        }
        assert lengths == {count}
        frames += count
    assert frames > 3500
    for path in sorted((real_data / "kitti_tracking" / "labels").glob("*.txt")):
        detections = read_kitti_detections(real_data / "kitti_tracking" / "detections" / path.name)
        assert len(read_kitti_labels(path)) >= len(detections) > 0


def test_v2v4real_oncoming_cars_pass_on_the_left(real_data: Path) -> None:
    """Right-hand traffic tells left from right; so y is to the left in these files, and nothing must be mirrored."""
    left = {"oncoming": 0, "overtaken": 0}
    right = {"oncoming": 0, "overtaken": 0}
    for path in sorted((real_data / "v2v4real_detections").glob("*/labels/*.txt")):
        for track in tracks(read_v2v4real_labels(path)).values():
            frame, x, y, yaw = track.T
            abreast = int(np.abs(x).argmin())
            if len(track) < 10 or abs(x[abreast]) > 30 or abs(y[abreast]) > 25:
                continue
            speed = 10 * (x[-1] - x[0]) / (frame[-1] - frame[0])  # relative to the ego car, along its heading
            if np.cos(yaw[abreast]) < -0.9:
                kind = "oncoming"
            elif np.cos(yaw[abreast]) > 0.9 and speed < -5:
                kind = "overtaken"
            else:
                continue
            (left if y[abreast] > 0 else right)[kind] += 1
    assert left["oncoming"] > 10 * right["oncoming"] > 0
    assert right["overtaken"] > 5 * left["overtaken"]


def test_v2v4real_detections_match_labels(real_data: Path) -> None:
    """Both are in the ego frame: columns, signs and the frame offset are right or the boxes would not meet."""
    folder = real_data / "v2v4real_detections" / "val"
    labels = read_v2v4real_labels(folder / "labels" / "0005.txt")
    for side in ("ego", "other"):
        errors, turned = [], []
        for found, truth in zip(read_v2v4real_detections(folder / side / "0005.txt", len(labels)), labels, strict=True):
            sure = found[found.score > 0.5] if found.score is not None else found
            if len(sure) and len(truth):
                distance = np.linalg.norm(sure.center[:, None] - truth.center[None], axis=2)
                near = distance.min(axis=1) < 3.0
                errors += distance.min(axis=1)[near].tolist()
                turned += np.abs(np.sin(sure.yaw - truth.yaw[distance.argmin(axis=1)]))[near].tolist()
        assert np.median(errors) < 1.0
        assert np.median(turned) < np.sin(np.deg2rad(3))


def kitti_tracks(real_data: Path, sequence: str) -> list[dict[int, FloatArray]]:
    """Per track x, y, yaw by frame."""
    frames = read_kitti_labels(real_data / "kitti_tracking" / "labels" / f"{sequence}.txt")
    return [{int(row[0]): row[1:] for row in track} for track in tracks(frames).values()]


@pytest.mark.parametrize("sequence", ["0001", "0006", "0008", "0010", "0012"])
def test_kitti_cars_are_as_long_as_they_move(real_data: Path, sequence: str) -> None:
    """Seen from a camera that drives along the road, parked and driving cars all move along their length."""
    along = []
    for track in kitti_tracks(real_data, sequence):
        for frame in track.keys() & {later - 10 for later in track}:
            step = track[frame + 10] - track[frame]
            if np.hypot(*step[:2]) > 3.0:
                along.append(abs(np.cos(np.arctan2(step[1], step[0]) - track[frame][2])))
    assert len(along) > 20
    assert np.median(along) > 0.99


def test_kitti_yaw_turns_the_way_positions_turn(real_data: Path) -> None:
    """When the camera turns, the line between two parked cars and their headings turn by the same angle."""
    lines, headings = [], []
    parked = kitti_tracks(real_data, "0001")
    for one in parked:
        for other in parked:
            common = one.keys() & other.keys()
            for frame in common & {later - 10 for later in common}:
                before, after = (one[f] - other[f] for f in (frame, frame + 10))
                apart = np.hypot(*before[:2])
                if apart > 5.0 and abs(apart - np.hypot(*after[:2])) < 0.15:
                    lines.append(np.angle(complex(*after[:2]) / complex(*before[:2])))
                    headings.append(np.angle(np.exp(1j * (one[frame + 10][2] - one[frame][2]))))
    assert np.corrcoef(lines, headings)[0, 1] > 0.9


def test_kitti_cars_drive_forward(real_data: Path) -> None:
    """In this sequence cars cross in front of a camera that stands."""
    forward = []
    for track in kitti_tracks(real_data, "0012"):
        for frame in track.keys() & {later - 5 for later in track}:
            across = track[frame + 5][1] - track[frame][1]
            if abs(across) > 1.0:
                forward.append(across * np.sin(track[frame][2]) > 0)
    assert len(forward) > 10
    assert np.mean(forward) > 0.9
