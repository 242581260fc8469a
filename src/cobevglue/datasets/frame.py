"""Common interface of all data sets: scenarios, frames, and the cloud, pose and objects of each agent."""

from __future__ import annotations

import difflib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar, overload

import numpy as np

from cobevglue.boxes import Boxes, covers_origin
from cobevglue.datasets.poses import inverse_SE3, transform_boxes
from cobevglue.typing import Float32Array, FloatArray, IntArray

__all__ = ["AgentFrame", "Dataset", "Frame", "Scenario", "did_you_mean"]


@dataclass(frozen=True, eq=False)
class AgentFrame:
    """One agent in one frame. Properties are read from files at first use, and cached.

    Attributes:
        read_labels: reads `world_SE3_lidar` and `objects`, which are stored together.
        read_points: reads `points`.
        is_infrastructure: whether it is a roadside unit, which is never the ego.
    """

    read_labels: Callable[[], tuple[FloatArray, Boxes]]
    read_points: Callable[[], Float32Array | None]
    is_infrastructure: bool = False

    @cached_property
    def points(self) -> Float32Array | None:
        """(N, 4) x, y, z [m] and intensity [0, 1] in the agent's LiDAR frame; None if no cloud is stored.

        Raises:
            ValueError: the file is malformed; the message names it.
        """
        return self.read_points()

    @cached_property
    def _labels(self) -> tuple[FloatArray, Boxes]:
        world_SE3_lidar, objects = self.read_labels()
        world_SE3_lidar.setflags(write=False)
        return world_SE3_lidar, objects

    @property
    def world_SE3_lidar(self) -> FloatArray:
        """(4, 4) pose of the LiDAR in the data set's world frame, converted to right-handed axes.

        Raises:
            ValueError: the file is malformed; the message names it and the field.
            FileNotFoundError: it does not exist.
        """
        return self._labels[0]

    @property
    def objects(self) -> Boxes:
        """The labelled objects visible to this agent, in its own LiDAR frame, without its own vehicle.

        `track_id` is the data set's object id: the same for all agents and frames of a scenario. It is None if the
        data set has no ids (DAIR-V2X).

        Raises:
            ValueError: the file is malformed; the message names it and the object.
            FileNotFoundError: it does not exist.
        """
        return self._labels[1]


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of all agents.

    Attributes:
        scenario: name of the scenario.
        timestamp: name of the frame on disk.
        time: seconds since the first frame of the scenario.
        agents: agents with data in this frame by name; vehicles first, sorted.
        read_common_objects: reads the labels common to all agents, given `world_SE3_ego`, in the ego's LiDAR frame;
            None if the data set has labels per agent only.
    """

    scenario: str
    timestamp: str
    time: float
    agents: Mapping[str, AgentFrame]
    read_common_objects: Callable[[FloatArray], Boxes] | None = None

    def ground_truth(self, ego: str, include_ego: bool = False) -> Boxes:
        """The objects visible to any agent, in the LiDAR frame of `ego`: the ground truth of cooperative perception.

        The union over agents by object id, where the ego's own label of an object has priority. For DAIR-V2X, the
        objects of the cooperative label file.

        Args:
            ego: name of an agent.
            include_ego: keep the box of the ego itself, as labelled by others. It is the box that contains the ego's
                LiDAR, since not all data sets name agents by object id.

        Raises:
            ValueError: unknown agent, or a malformed file.
        """
        if ego not in self.agents:
            raise ValueError(f"frame {self.timestamp} of {self.scenario} has no agent {did_you_mean(ego, self.agents)}")
        if self.read_common_objects is not None:
            union = self.read_common_objects(self.agents[ego].world_SE3_lidar)
        else:
            ego_SE3_world = inverse_SE3(self.agents[ego].world_SE3_lidar)
            parts = [self.agents[ego].objects]
            known = _ids(parts[0])
            for name, agent in self.agents.items():
                if name != ego:
                    new = agent.objects[~np.isin(_ids(agent.objects), known)]
                    parts.append(transform_boxes(new, ego_SE3_world @ agent.world_SE3_lidar))
                    known = np.concatenate([known, _ids(new)])
            union = Boxes.concatenate(parts)
        return union if include_ego else union[~covers_origin(union)]

    def own_vehicle(self, agent: str) -> Boxes | None:
        """The vehicle that carries an agent's LiDAR, as labelled by another agent.

        Args:
            agent: name of an agent.

        Returns:
            One box without `track_id` in the agent's LiDAR frame; None for a roadside unit, and if it is not labelled.

        Raises:
            ValueError: unknown agent, or a malformed file.
        """
        if agent in self.agents and self.agents[agent].is_infrastructure:
            return None
        objects = self.ground_truth(agent, include_ego=True)
        own = objects[covers_origin(objects)]
        return own.replace(track_id=None, score=None) if len(own) == 1 else None


class Scenario(Sequence[Frame]):
    """The frames of one recording in temporal order; indexing creates a new `Frame` without reading its files."""

    def __init__(self, name: str, frame_count: int, make_frame: Callable[[int], Frame]) -> None:
        """Frames `make_frame(0)` to `make_frame(frame_count - 1)`."""
        self.name = name
        self._frames = range(frame_count)
        self._make_frame = make_frame

    def __len__(self) -> int:
        return len(self._frames)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Frame]: ...
    def __getitem__(self, index: int | slice) -> Frame | Sequence[Frame]:
        if isinstance(index, slice):
            return [self._make_frame(i) for i in self._frames[index]]
        try:
            return self._make_frame(self._frames[index])
        except IndexError:
            raise IndexError(f"scenario {self.name} has {len(self)} frames, no frame {index}") from None

    def __repr__(self) -> str:
        return f"Scenario({self.name!r}, {len(self)} frames)"


class Dataset(ABC):
    """A split of a data set: a collection of scenarios, indexed by name. Iterating yields the scenarios.

    Attributes:
        scenarios: names of the scenarios, sorted.
        training_split: name of the split to train on.
        validation_split: name of the split to validate on.
    """

    training_split: ClassVar[str] = "train"
    validation_split: ClassVar[str] = "validate"
    scenarios: tuple[str, ...]

    @abstractmethod
    def __init__(self, root: str | Path, split: str) -> None:
        """List the scenarios of a split of the data set at `root`."""

    @property
    def cloud_location(self) -> str:
        """Expected location of the clouds, for error messages."""
        return f"the clouds of {self!r}"

    def __getitem__(self, name: str) -> Scenario:
        """The scenario of this name.

        Raises:
            ValueError: unknown name; the message suggests the most similar one.
        """
        if name not in self.scenarios:
            raise ValueError(f"{self}: no scenario {did_you_mean(name, self.scenarios)}")
        return self._scenario(name)

    def __iter__(self) -> Iterator[Scenario]:
        return (self._scenario(name) for name in self.scenarios)

    def __len__(self) -> int:
        return len(self.scenarios)

    @abstractmethod
    def _scenario(self, name: str) -> Scenario: ...


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """Suffix of an error message: the given name, the most similar valid one, and all valid ones if they are few."""
    names = [str(candidate) for candidate in valid]
    nearest = difflib.get_close_matches(str(name), names, n=1, cutoff=0.0)
    listed = f" (there are: {', '.join(names)})" if 1 < len(names) <= 8 else ""
    return f"{name!r}; did you mean {nearest[0]!r}?{listed}" if nearest else f"{name!r}; there are none"


def _ids(boxes: Boxes) -> IntArray:
    if boxes.track_id is None:
        raise ValueError("the union of the objects of all agents needs objects with a track_id")
    return boxes.track_id
