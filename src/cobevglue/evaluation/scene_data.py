"""Sequences of simulated scenes to evaluate aligners on, where the other agent's lists may be late."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from cobevglue.evaluation.alignment import AlignmentSequence, PairFrame
from cobevglue.simulation.object_lists import AgentView, SensorSettings, observe
from cobevglue.simulation.object_scenes import SCENES, Scene
from cobevglue.tracking import Sort

__all__ = ["scene_of", "scene_sequence", "scene_sequences"]

_FRAME = 0.1
_MOST_DELAY = 1.0
"""Traffic is simulated for this long before and after the ego's frames [s]."""
_SENSOR = SensorSettings(min_visible=0.1)
"""A corner is enough to detect a vehicle: with more, cars parked side by side would be invisible from 5 m."""
_SCENE_STREAM, _EGO_STREAM, _OTHER_STREAM, _JITTER_STREAM = range(4)


def scene_sequences(
    name: str,
    seeds: Iterable[int],
    delay: float = 0.0,
    jitter: float = 0.0,
    duration: float = 8.0,
    sensor: SensorSettings | None = None,
) -> Iterator[AlignmentSequence]:
    """The sequences of one scene: `scene_sequence` for each seed."""
    return (scene_sequence(name, seed, delay, jitter, duration, sensor) for seed in seeds)


def scene_sequence(
    name: str,
    seed: int,
    delay: float = 0.0,
    jitter: float = 0.0,
    duration: float = 8.0,
    sensor: SensorSettings | None = None,
) -> AlignmentSequence:
    """Two agents of a simulated scene: tracked detections, 0.1 s apart, and the ground truth.

    The ego's frames and detections, and the random numbers of the other's detection errors, do not depend on the delay.

    Args:
        name: of the scene, a key of `SCENES`.
        seed: integer >= 0 of the scene and of the detection errors.
        delay: the other's lists show the world this much before the ego's frames [s]; within 1 s, jitter included.
        jitter: the delay of each list is evenly spread within this much of `delay` [s]; below 0.05 s.
        duration: of the sequence [s].
        sensor: of both agents; by default that of `Junction`, but a tenth of a vehicle is enough to detect it.

    Returns:
        Frames with tracked boxes: `other` in the other's frame at the instant of its list. `ego_SE2_other` has both
        frames at the ego's instant, `time_offset` is minus the delay of the list, bodies are given except a mast's.

    Raises:
        ValueError: no such scene, a delay beyond 1 s or so large a jitter that lists would overtake each other.
    """
    if not 0.0 <= jitter < _FRAME / 2.0:
        raise ValueError(f"jitter must be at least 0 and below {_FRAME / 2.0} s, got {jitter}")
    if not abs(delay) + jitter <= _MOST_DELAY:
        raise ValueError(f"delay must be within {_MOST_DELAY} s, jitter included, got {delay}")
    sensor = sensor or _SENSOR
    scene = scene_of(name, seed, duration)
    ego, other = scene.agents
    ego_tracker, other_tracker = Sort(), Sort()
    frames = []
    for i in range(max(1, round(duration / _FRAME))):
        time = _MOST_DELAY + _FRAME * i
        late = delay + jitter * float(np.random.default_rng([seed, _JITTER_STREAM, i]).uniform(-1.0, 1.0))
        mine = _view(scene, ego, time, sensor, [seed, _EGO_STREAM, i])
        theirs = _view(scene, other, time - late, sensor, [seed, _OTHER_STREAM, i])
        same = (mine.object_id[:, None] == theirs.object_id[None, :]) & (mine.object_id[:, None] >= 0)
        pairs = np.argwhere(same)
        frames.append(
            PairFrame(
                ego_tracker.update(mine.boxes, time),
                other_tracker.update(theirs.boxes, time - late),
                mine.world_SE2_agent.inverse() @ scene.pose(other, time),
                len(pairs),
                pairs,
                mine.body,
                theirs.body,
                time,
                -late,
            )
        )
    return AlignmentSequence(f"{name}/{seed}", frames)


def scene_of(name: str, seed: int, duration: float = 8.0) -> Scene:
    """The traffic and the agents of `scene_sequence`; the ego's first frame is at 1 s.

    Raises:
        ValueError: no such scene.
    """
    if name not in SCENES:
        raise ValueError(f"no scene {name!r}; there are {', '.join(SCENES)}")
    rng = np.random.default_rng([seed, _SCENE_STREAM, list(SCENES).index(name)])
    return SCENES[name](rng, duration + 2.0 * _MOST_DELAY)


def _view(scene: Scene, agent: str, time: float, sensor: SensorSettings, key: list[int]) -> AgentView:
    return observe(scene.traffic.at(time), scene.agents[agent], sensor, np.random.default_rng(key))
