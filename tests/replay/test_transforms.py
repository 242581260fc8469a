"""Lists in a map, brought back into the frame of a vehicle that drives and turns, by its recorded transforms."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace as Message
from typing import Any

import numpy as np
import pytest

from cobevglue import SE2, Boxes
from cobevglue.datasets.poses import SE3_from_SE2
from cobevglue.replay.transforms import TRANSFORMS, Transforms, transform_topics

OWN = Boxes([(10, 2, -1), (20, -5, -0.5)], [(4.5, 1.9, 1.5), (8, 2.5, 3)], [0.3, -3.0])
LIDAR = SE2(1.5, 0.0, 0.1)  # on the vehicle


def vehicle(time: float) -> SE2:
    """map_SE2_base_link of a vehicle that drives to the north at 10 m/s and turns left."""
    return SE2(89_000.0, 42_000.0 + 10.0 * time, math.pi / 2 + 0.3 * time)


def transform(time: float, parent: str, child: str, pose: SE2) -> dict[str, Any]:
    stamp = {"sec": int(time), "nanosec": round(1e9 * (time % 1.0))}
    rotation = {"x": 0.0, "y": 0.0, "z": math.sin(pose.yaw / 2), "w": math.cos(pose.yaw / 2)}
    place = {"translation": {"x": pose.x, "y": pose.y, "z": 0.0}, "rotation": rotation}
    return {"header": {"stamp": stamp, "frame_id": parent}, "child_frame_id": child, "transform": place}


def message(*transforms: dict[str, Any]) -> Any:
    def spaced(value: Any) -> Any:
        return Message(**{key: spaced(each) for key, each in value.items()}) if isinstance(value, dict) else value

    return Message(transforms=[spaced(each) for each in transforms])


def tree(*times: float) -> Transforms:
    made = Transforms()
    made.add(message(transform(0.0, "base_link", "/lidar", LIDAR)))
    for time in times:
        made.add(message(transform(time, "map", "base_link", vehicle(time))))
    return made


@pytest.mark.parametrize(
    ("target", "source", "expected"),
    [
        ("base_link", "map", vehicle(1.0).inverse()),
        ("map", "base_link", vehicle(1.0)),
        ("lidar", "map", (vehicle(1.0) @ LIDAR).inverse()),
        ("base_link", "lidar", LIDAR),
        ("base_link", "/base_link", SE2()),
    ],
)
def test_chain_between_frames(target: str, source: str, expected: SE2) -> None:
    np.testing.assert_allclose(tree(0.9, 1.0, 1.1).between(target, source, 1.0), SE3_from_SE2(expected), atol=1e-8)


def test_pose_between_two_transforms() -> None:
    found = tree(1.0, 1.1).between("map", "base_link", 1.05)
    np.testing.assert_allclose(found, SE3_from_SE2(vehicle(1.05)), atol=1e-3)


@pytest.mark.parametrize(("time", "nearest"), [(0.8, 1.0), (1.4, 1.2)], ids=["before the first", "after the last"])
def test_nearest_transform_outside_of_all(time: float, nearest: float) -> None:
    found = tree(1.0, 1.2).between("map", "base_link", time)
    np.testing.assert_allclose(found, SE3_from_SE2(vehicle(nearest)), atol=1e-8)


def test_transforms_in_any_order() -> None:
    found = tree(1.2, 1.0, 1.1).between("map", "base_link", 1.1)
    np.testing.assert_allclose(found, SE3_from_SE2(vehicle(1.1)), atol=1e-8)


def test_missing_transforms_are_named() -> None:
    with pytest.raises(ValueError, match=r"no transform from 'odom' to 'lidar'; there are the frames base_link, lidar"):
        tree().between("lidar", "odom", 0.0)
    with pytest.raises(ValueError, match=r"nearest transform of 'base_link' is 0.90 s away"):
        tree(1.0, 1.1).between("map", "base_link", 2.0)
    circle = tree()
    circle.add(message(transform(0.0, "lidar", "base_link", SE2())))
    with pytest.raises(ValueError, match="circle"):
        circle.between("base_link", "map", 0.0)


@pytest.mark.parametrize(
    ("topics", "found"),
    [
        (["/tf", "/tf_static"], ["/tf", "/tf_static"]),
        (["/tf", "/a/tf", "/a/tf_static", "/b/tf"], ["/a/tf", "/a/tf_static"]),
        (["/tf", "/b/tf"], ["/tf"]),
        (["/b/tf"], []),
    ],
)
def test_topics_of_an_agent(topics: list[str], found: list[str]) -> None:
    assert transform_topics("/a/perception/objects", dict.fromkeys(topics, TRANSFORMS)) == found


def test_lists_in_a_map_are_brought_back(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="recordings need rosbags")
    from cobevglue.recordings import open_recording
    from cobevglue.replay import Replay

    from .bags import DETECTION3DARRAY, detection, detections, write_bag

    times = [1.0, 1.1, 1.2]
    entries: list[Any] = [
        ("/tf", TRANSFORMS, time, {"transforms": [transform(time, "map", "base_link", vehicle(time))]})
        for time in np.arange(0.9, 1.3, 0.02)
    ]
    for time in times:
        in_map = OWN.transform(vehicle(time))
        items = [detection(x, y) for x, y in in_map.center[:, :2]]
        entries.append(("/a/objects", DETECTION3DARRAY, time + 0.05, detections(time, *items, frame_id="map")))
        entries.append(("/b/objects", DETECTION3DARRAY, time + 0.04, detections(time, detection(5, 5))))
    with open_recording(write_bag(tmp_path / "bag", sorted(entries, key=lambda entry: entry[2]))) as recording:
        frames = list(Replay(recording))
        assert len(frames) == 3
        for frame in frames:
            np.testing.assert_allclose(frame.seen.lists["a"].center[:, :2], OWN.center[:, :2], atol=1e-2)
            np.testing.assert_allclose(frame.seen.lists["b"].center[:, :2], [[5, 5]])
        elsewhere = Replay(recording, frames={"a": "b/base_link"})
        with pytest.raises(ValueError, match=r"/a/objects: message 1 .*no transform from 'map' to 'b/base_link'"):
            list(elsewhere)
