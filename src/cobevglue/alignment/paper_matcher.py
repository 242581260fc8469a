"""The matching of the paper as printed (section 4.2)."""

from __future__ import annotations

import numpy as np

from cobevglue.alignment.alignment import Alignment
from cobevglue.alignment.common_subgraph import common_subgraph, surviving_pairs
from cobevglue.alignment.config import BEVGlueConfig
from cobevglue.alignment.hypotheses import PoseHypothesis
from cobevglue.alignment.object_graph import ObjectGraph
from cobevglue.alignment.procrustes import procrustes
from cobevglue.boxes import Boxes
from cobevglue.typing import FloatArray, IntArray

__all__ = ["PaperMatcher"]


class PaperMatcher:
    """The method as printed: graphs, temporally consistent maximum common subgraph, SVD."""

    hypotheses: tuple[PoseHypothesis, ...] = ()

    def __init__(self, config: BEVGlueConfig) -> None:
        self._config = config
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._track_pairs: IntArray = np.zeros((0, 2), np.int64)

    def align(self, ego: Boxes, other: Boxes) -> Alignment:
        """The pose of one pair of frames.

        Args:
            ego: in the ego frame.
            other: in the other agent's frame.
        """
        ego_graph, other_graph = ObjectGraph.of(ego), ObjectGraph.of(other)
        carried = surviving_pairs(ego_graph, other_graph, self._track_pairs)
        pairs, confidence = common_subgraph(
            ego_graph, other_graph, carried if len(carried) else None, self._config.affinity
        )
        if ego.track_id is not None and other.track_id is not None:
            self._track_pairs = np.column_stack([ego.track_id[pairs[:, 0]], other.track_id[pairs[:, 1]]])
        if len(pairs) < 2:
            return Alignment.refused("fewer than two common objects: no rotation", evidence=confidence)
        pose = procrustes(ego_graph.position[pairs[:, 0]], other_graph.position[pairs[:, 1]])
        arms = pose.rotation @ other_graph.position[pairs[:, 1]].T
        return Alignment(pose, pairs, _fit_covariance(arms, self._config.position_std), evidence=confidence)


def _fit_covariance(arms: FloatArray, position_std: float) -> FloatArray:
    """(3, 3) covariance of a least-squares pose from (2, K) rotated points with independent errors."""
    k = arms.shape[1]
    information = np.diag([float(k), float(k), float((arms**2).sum())])
    information[0, 2] = information[2, 0] = -arms[1].sum()
    information[1, 2] = information[2, 1] = arms[0].sum()
    covariance: FloatArray = np.linalg.pinv(information) * position_std**2
    return covariance
