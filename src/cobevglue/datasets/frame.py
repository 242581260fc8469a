"""What every data set hands out: scenarios of frames, a frame of agents, an agent's cloud, pose and objects."""

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
    """One agent at one time. Files are read when a property is first used, and kept as long as this object lives.

    Attributes:
        read_labels: reads `world_SE3_lidar` and `objects`; they are stored together.
        read_points: reads `points`.
        is_infrastructure: a roadside unit, which never is the ego.
    """

    read_labels: Callable[[], tuple[FloatArray, Boxes]]
    read_points: Callable[[], Float32Array | None]
    is_infrastructure: bool = False

    @cached_property
    def points(self) -> Float32Array | None:
        """(N, 4) x, y, z [m] and intensity [0, 1] in the agent's LiDAR frame; None where no cloud is stored.

        Raises:
            ValueError: the file is broken; names it.
        """
        return self.read_points()

    @cached_property
    def _labels(self) -> tuple[FloatArray, Boxes]:
        world_SE3_lidar, objects = self.read_labels()
        world_SE3_lidar.setflags(write=False)
        return world_SE3_lidar, objects

    @property
    def world_SE3_lidar(self) -> FloatArray:
        """(4, 4) pose of the LiDAR in the data set's world, made right-handed; always a proper rotation.

        Raises:
            ValueError: the file is broken; names it and the field.
            FileNotFoundError: it is not there.
        """
        return self._labels[0]

    @property
    def objects(self) -> Boxes:
        """The objects that this agent could see, in its own LiDAR frame, labelled; its own body is not among them.

        `track_id` is the data set's object id: the same for all agents of a scenario, and over its frames. It is None
        where the data set has none (DAIR-V2X).

        Raises:
            ValueError: the file is broken; names it and the object.
            FileNotFoundError: it is not there.
        """
        return self._labels[1]


@dataclass(frozen=True, eq=False)
class Frame:
    """All agents at one time.

    Attributes:
        scenario: name of the scenario.
        timestamp: name of the frame as on disk.
        time: seconds since the first frame of the scenario.
        agents: the agents that have this frame; vehicles first, in the order of their names.
        read_common_objects: reads the labels made for all agents together, given `world_SE3_ego`, in the ego's LiDAR
            frame; None where the data set has labels per agent only.
    """

    scenario: str
    timestamp: str
    time: float
    agents: Mapping[str, AgentFrame]
    read_common_objects: Callable[[FloatArray], Boxes] | None = None

    def ground_truth(self, ego: str, include_ego: bool = False) -> Boxes:
        """What all agents together could see, in the LiDAR frame of `ego`: the truth of cooperative perception.

        This is the union over agents by object id, where the ego's own label of an object wins; for DAIR-V2X it is the
        cooperative label file.

        Args:
            ego: name of an agent.
            include_ego: keep the box of the ego itself, labelled by the others. It is told by standing on the ego's
                LiDAR, as not all data sets name agents by object id.

        Raises:
            ValueError: no such agent; or a file is broken.
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


class Scenario(Sequence[Frame]):
    """The frames of one drive in the order of time; each is made anew, with nothing read, when it is asked for."""

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
    """A split of a data set: its scenarios by name. Iterating gives the scenarios; `len` is how many there are.

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
        """Look at which scenarios the split of this name has, in the data set kept at `root`."""

    @property
    def cloud_location(self) -> str:
        """Where the files of the clouds are expected, for error messages."""
        return f"the clouds of {self!r}"

    def __getitem__(self, name: str) -> Scenario:
        """The scenario of this name.

        Raises:
            ValueError: there is none; names the nearest.
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
    """The end of an error line: the name as given, the nearest valid one, and all of them if they are few."""
    names = [str(candidate) for candidate in valid]
    nearest = difflib.get_close_matches(str(name), names, n=1, cutoff=0.0)
    listed = f" (there are: {', '.join(names)})" if 1 < len(names) <= 8 else ""
    return f"{name!r}; did you mean {nearest[0]!r}?{listed}" if nearest else f"{name!r}; there are none"


def _ids(boxes: Boxes) -> IntArray:
    if boxes.track_id is None:
        raise ValueError("the union of what agents see needs objects with a track_id")
    return boxes.track_id
