"""Object lists of several agents, aligned and fused: on the simulated junction and on small hand-made lists."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping

import numpy as np
import pytest

from cobevglue import SE2, Alignment, Boxes
from cobevglue.alignment import GroupAligner, Observation, group_aligner
from cobevglue.iou import bev_iou
from cobevglue.object_collaboration import ObjectCollaboration
from cobevglue.simulation import Junction, JunctionSettings

CAR = (4.5, 1.9, 1.5)


def cars(*places: tuple[float, float], **columns: list[float] | list[int] | list[str]) -> Boxes:
    return Boxes([(x, y, 0.0) for x, y in places], [CAR] * len(places), [0.0] * len(places), **columns)


class Fixed(GroupAligner):
    """The other agents are where this says, the rest is refused; keeps what it was given."""

    needs = frozenset({"boxes"})

    def __init__(self, poses: Mapping[str, SE2]) -> None:
        self.poses = poses
        self.given: list[dict[str, Observation]] = []

    def align_group(
        self, ego: str, observations: Mapping[str, Observation], time: float | None = None
    ) -> dict[str, Alignment]:
        self.given.append(dict(observations))
        return {
            name: Alignment(self.poses[name]) if name in self.poses else Alignment.refused("unknown")
            for name in observations
            if name != ego
        }


def ids(boxes: Boxes) -> list[int]:
    assert boxes.track_id is not None
    return [int(number) for number in boxes.track_id]


def test_three_agents_find_each_other() -> None:
    collaboration = ObjectCollaboration()
    settings = JunctionSettings(agents=3, duration=3.0)
    for frame in Junction(seed=3, settings=settings):
        lists = {name: view.boxes.replace(track_id=None) for name, view in frame.agents.items()}
        seen = collaboration.step(lists, "car1", frame.time)
    for name in ("car2", "car3"):
        pose, truth = seen.alignments[name].ego_SE2_other, frame.ego_SE2_other("car1", name)
        assert pose is not None, seen.alignments[name].reason
        assert np.hypot(pose.x - truth.x, pose.y - truth.y) < 1.0
    assert len(seen.objects) > len(lists["car1"])
    overlap = bev_iou(seen.objects, seen.objects)
    assert (overlap[~np.eye(len(overlap), dtype=bool)] <= 0.15).all(), "no object is there twice"


def test_refused_lists_are_not_fused() -> None:
    own, other = cars((10, 0)), cars((10, 0), (30, 0))
    seen = ObjectCollaboration(Fixed({})).step({"a": own, "b": other}, "a")
    assert len(seen.objects) == 1
    assert seen.alignments["b"].reason == "unknown"


def test_fused_objects_are_each_there_once() -> None:
    own = cars((10, 0), score=[0.5], label=["van"])
    other = cars((0, 0.2), (20, 0), score=[0.9, 0.7], label=["car", "bus"])  # the first is the ego's, better seen
    seen = ObjectCollaboration(Fixed({"b": SE2(10.0, 0.0, 0.0)})).step({"a": own, "b": other}, "a")
    assert seen.objects.center[:, 0].tolist() == [10.0, 30.0]
    assert seen.objects.label is not None
    assert seen.objects.label.tolist() == ["car", "bus"]
    assert seen.objects.score is not None
    np.testing.assert_allclose(seen.objects.score, [1 - 0.55 * 0.19, 0.63])


def test_own_vehicles_are_fused_once() -> None:
    own, other = cars((20, 5)), cars((-14, 0), (30, 0))  # the other sees the ego's vehicle, 1 m ahead of its origin
    bodies = {"a": cars((1.0, 0.0)), "b": cars((0.0, 0.0))}
    seen = ObjectCollaboration(Fixed({"b": SE2(15.0, 0.0, 0.0)})).step({"a": own, "b": other}, "a", bodies=bodies)
    assert sorted(seen.objects.center[:, 0].tolist()) == [15.0, 20.0, 45.0], "the other's vehicle, not the ego's"


def test_lists_are_tracked_where_needed() -> None:
    collaboration = ObjectCollaboration(Fixed({}))
    for step in range(3):
        boxes = {"a": cars((10 + step, 0), (40, 9)), "b": cars((5, 5), track_id=[77])}
        seen = collaboration.step(boxes, "a", 0.1 * step)
        assert ids(seen.lists["a"]) == [0, 1]
        assert ids(seen.lists["b"]) == [77]


def test_same_list_again_keeps_its_tracks() -> None:
    collaboration = ObjectCollaboration(aligner := Fixed({}))
    boxes = {"a": cars((10, 0)), "b": cars((5, 5))}
    first = collaboration.step(boxes, "a", 0.0, {"b": 50.0})
    again = collaboration.step(boxes, "a", 0.1, {"b": 50.0})
    assert ids(again.lists["b"]) == ids(first.lists["b"])
    assert [seen["b"].time for seen in aligner.given] == [50.0, 50.0]


def test_agents_come_and_go() -> None:
    collaboration = ObjectCollaboration()
    frames = list(Junction(seed=3, settings=JunctionSettings(duration=2.0)))
    for step, frame in enumerate(frames):
        lists = {name: view.boxes for name, view in frame.agents.items() if name == "car1" or step % 3}
        seen = collaboration.step(lists, "car1", frame.time)
        assert set(seen.alignments) == set(lists) - {"car1"}
    assert seen.alignments["car2"].accepted


def test_forgotten_agent_may_go_back_in_time() -> None:
    collaboration = ObjectCollaboration()
    boxes = {"a": cars((10, 0)), "b": cars((5, 5))}
    collaboration.step(boxes, "a", 0.0, {"b": 50.0})
    with pytest.raises(ValueError, match="b: time must not be earlier"):
        collaboration.step(boxes, "a", 0.1, {"b": 10.0})
    collaboration.forget("b")
    collaboration.forget("nobody")
    assert ids(collaboration.step(boxes, "a", 0.2, {"b": 10.0}).lists["b"]) == [0]


@pytest.mark.parametrize("aligner", ["bevglue", "bevglue-group"])
def test_forgotten_agent_has_no_pose(aligner: str) -> None:
    """After some frames a pair of frames with little in common is accepted: not so after the agent was forgotten."""
    collaboration = ObjectCollaboration(group_aligner(aligner))
    frames = list(Junction(seed=3, settings=JunctionSettings(agents=3, duration=3.0)))
    for frame in frames[:-1]:
        seen = collaboration.step({name: view.boxes for name, view in frame.agents.items()}, "car1", frame.time)
    assert seen.alignments["car2"].accepted
    assert seen.alignments["car3"].accepted
    collaboration.forget("car2")
    last = {name: view.boxes[:2] for name, view in frames[-1].agents.items()}
    seen = collaboration.step(last, "car1", frames[-1].time)
    assert not seen.alignments["car2"].accepted


def test_another_ego_starts_anew() -> None:
    collaboration = ObjectCollaboration()
    for frame in Junction(seed=3, settings=JunctionSettings(duration=1.0)):
        lists = {name: view.boxes for name, view in frame.agents.items()}
        seen = collaboration.step(lists, "car1", frame.time)
    assert seen.alignments["car2"].accepted
    with_other_ego = collaboration.step(lists, "car2", frame.time)
    fresh = ObjectCollaboration().step(lists, "car2", frame.time)
    assert with_other_ego.alignments["car1"].evidence == fresh.alignments["car1"].evidence


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"ego": "c"}, "ego: there is no agent 'c'"),
        ({"ego": "a", "time": 0.0}, "time must be later than the last one"),
        ({"ego": "a", "times": {"b": -5.0}}, "b: time must not be earlier than the last one"),
        ({"ego": "a", "bodies": {"b": cars((0, 0), (1, 1))}}, "other_body must have one row"),
    ],
    ids=["unknown ego", "the same time twice", "an older list", "a body of two rows"],
)
def test_bad_input_is_named(arguments: dict[str, object], message: str) -> None:
    collaboration = ObjectCollaboration()
    boxes = {"a": cars((10, 0)), "b": cars((5, 5))}
    collaboration.step(boxes, "a", 0.0)
    with pytest.raises(ValueError, match=message):
        collaboration.step(boxes, **arguments)  # type: ignore[arg-type]


def test_torch_is_not_imported() -> None:
    code = "import sys, cobevglue.object_collaboration; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
