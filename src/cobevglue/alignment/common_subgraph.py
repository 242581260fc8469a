"""Temporally consistent maximum common subgraph, as the paper has it (section 4.2): candidates, expansion, selection.

Plain NumPy, and the reference for what the robust variant changes. Where the text is silent: affinities and thresholds
are `AffinityConfig`; when no pair of the last subgraph is still tracked by both agents, all pairs seed again.
"""

from __future__ import annotations

import numpy as np

from cobevglue.alignment.config import AffinityConfig
from cobevglue.alignment.object_graph import ObjectGraph
from cobevglue.se2 import wrap_angle
from cobevglue.typing import BoolArray, FloatArray, IntArray

__all__ = ["common_subgraph", "edge_affinity", "node_affinity", "surviving_pairs"]


def node_affinity(ego: ObjectGraph, other: ObjectGraph, config: AffinityConfig) -> FloatArray:
    """phi_V: (M, N) similarity of the footprints, 1 when equal."""
    gap = (ego.node[:, None, :] - other.node[None, :, :]) / (config.length_scale, config.width_scale)
    affinity: FloatArray = np.exp(-(gap**2).sum(axis=-1))
    return affinity


def edge_affinity(ego_edge: FloatArray, other_edge: FloatArray, config: AffinityConfig) -> FloatArray:
    """phi_E of broadcastable edges (..., 3): 1 when they lead to the same place with the same heading."""
    gap = np.abs(
        ego_edge[..., 0] * np.exp(1j * ego_edge[..., 1]) - other_edge[..., 0] * np.exp(1j * other_edge[..., 1])
    )
    turn = wrap_angle(ego_edge[..., 2] - other_edge[..., 2])
    affinity: FloatArray = np.exp(-((gap / config.position_scale) ** 2) - (turn / config.heading_scale) ** 2)
    return affinity


def common_subgraph(
    ego: ObjectGraph, other: ObjectGraph, seeds: IntArray | None, config: AffinityConfig
) -> tuple[IntArray, float]:
    """The maximum common subgraph and its confidence (Eq. 5).

    Args:
        ego: graph of M nodes.
        other: graph of N nodes.
        seeds: (S, 2) candidate pairs; None for all M x N pairs of the first frame.
        config: affinities and thresholds.

    Returns:
        (K, 2) rows of ego and other, the seed among them, and the confidence; no rows when no pair is similar enough.
    """
    nodes = node_affinity(ego, other, config)
    similar = nodes > config.node_threshold
    if seeds is None:
        seeds = np.argwhere(similar)
    best: IntArray = np.zeros((0, 2), np.int64)
    confidence = 0.0
    for p, q in seeds:
        if not similar[p, q]:
            continue
        members = _expand(ego, other, int(p), int(q), similar, config)
        if len(members) < len(best):
            continue
        score = _confidence(ego, other, members, nodes, config)
        if len(members) > len(best) or score > confidence:
            best, confidence = members, score
    return best, confidence


def _expand(
    ego: ObjectGraph, other: ObjectGraph, p: int, q: int, similar: BoolArray, config: AffinityConfig
) -> IntArray:
    """All pairs whose edges from the seed (p, q) agree; the seed's own edge has length zero and always does."""
    edges = edge_affinity(ego.edge[p, :, None, :], other.edge[q, None, :, :], config)
    agree = similar & (edges > config.edge_threshold)
    agree[p, :] = False
    agree[:, q] = False
    agree[p, q] = True
    members: IntArray = np.argwhere(agree)
    return members


def _confidence(
    ego: ObjectGraph, other: ObjectGraph, members: IntArray, nodes: FloatArray, config: AffinityConfig
) -> float:
    """Eq. 5: node affinities of the members plus edge affinities of all ordered pairs of members."""
    m, n = members[:, 0], members[:, 1]
    edges = edge_affinity(ego.edge[np.ix_(m, m)], other.edge[np.ix_(n, n)], config)
    return float(nodes[m, n].sum() + edges.sum())


def surviving_pairs(ego: ObjectGraph, other: ObjectGraph, track_pairs: IntArray) -> IntArray:
    """(S, 2) rows of the (P, 2) track-id pairs of the last subgraph that both agents still track."""
    if ego.track_id is None or other.track_id is None or len(track_pairs) == 0:
        return np.zeros((0, 2), np.int64)
    ego_row = {int(track): row for row, track in enumerate(ego.track_id)}
    other_row = {int(track): row for row, track in enumerate(other.track_id)}
    rows = [(ego_row[a], other_row[b]) for a, b in track_pairs.tolist() if a in ego_row and b in other_row]
    return np.array(rows, np.int64).reshape(-1, 2)
