"""Base class of the matchers in `benchmarks/peers`: alignment of single frames without memory."""

from __future__ import annotations

import numpy as np

from cobevglue.alignment import Alignment
from cobevglue.alignment.procrustes import procrustes
from cobevglue.boxes import Boxes
from cobevglue.typing import BoolArray, FloatArray, IntArray

__all__ = ["SingleFrameMatcher", "distances", "pose_of_matches", "same_class"]


class SingleFrameMatcher:
    """A memoryless `Aligner`. Subclasses implement `match` and `published`; their defaults are from `peers.search`."""

    @classmethod
    def published(cls) -> SingleFrameMatcher:
        """Return the matcher with the settings of its paper or code, where these are known."""
        raise NotImplementedError

    def match(self, ego: Boxes, other: Boxes) -> Alignment:
        """Estimate the relative pose of two lists of at least two boxes each."""
        raise NotImplementedError

    def align(self, ego: Boxes, other: Boxes, time: float | None = None) -> Alignment:
        """Estimate ego_SE2_other; refused if a list has fewer than two boxes."""
        if min(len(ego), len(other)) < 2:
            return Alignment.refused(f"{len(ego)} and {len(other)} boxes, at least two each are needed")
        return self.match(ego, other)

    def reset(self) -> None:
        """Do nothing: the matcher has no memory."""


def pose_of_matches(ego: Boxes, other: Boxes, matches: IntArray, min_matches: int) -> Alignment:
    """Estimate the least-squares pose of matched box centres; refused with too few matches.

    Args:
        ego: M boxes in the ego frame.
        other: N boxes in the other agent's frame.
        matches: (K, 2) rows of ego and other.
        min_matches: minimum K that is accepted.
    """
    if len(matches) < min_matches:
        return Alignment.refused(f"{len(matches)} boxes matched, {min_matches} are needed")
    pose = procrustes(ego.center[matches[:, 0], :2], other.center[matches[:, 1], :2])
    return Alignment(pose, matches)


def distances(boxes: Boxes) -> FloatArray:
    """Return (N, N) horizontal distances between the centres [m]."""
    step = boxes.center[:, None, :2] - boxes.center[None, :, :2]
    length: FloatArray = np.hypot(step[..., 0], step[..., 1])
    return length


def same_class(ego: Boxes, other: Boxes) -> BoolArray:
    """Return (M, N) whether two boxes have the same label; True if a list has no labels."""
    if ego.label is None or other.label is None:
        return np.ones((len(ego), len(other)), np.bool_)
    same: BoolArray = ego.label[:, None] == other.label[None, :]
    return same
