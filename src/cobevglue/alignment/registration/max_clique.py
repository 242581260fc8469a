"""The largest clique of a graph: the most measurements that all agree with each other, pair by pair."""

from __future__ import annotations

import numpy as np

from cobevglue.typing import BoolArray, IntArray

__all__ = ["max_clique"]


def max_clique(adjacent: BoolArray, max_steps: int = 20_000) -> IntArray:
    """The largest set of vertices that are all adjacent to each other.

    Greedy cliques along the degeneracy ordering first, which are the largest or nearly so in the graphs that
    registration gives; then branch and bound with colours (Tomita and Seki, 2003), which proves it or finds a larger
    one. Sets of vertices are the bits of Python's integers.

    Args:
        adjacent: (N, N) symmetric; the diagonal is not looked at.
        max_steps: of branch and bound. After so many the largest clique so far is returned, which may not be the
            largest there is.

    Returns:
        (K,) vertices in ascending order; of several largest cliques always the same one.
    """
    if not len(adjacent):
        return np.zeros(0, np.int64)
    order, core = _degeneracy(adjacent)
    order, core = order[::-1], core[::-1]  # what is joined most comes first, as the lowest bits
    graph = adjacent[np.ix_(order, order)].copy()
    np.fill_diagonal(graph, False)
    neighbours = [int.from_bytes(row.tobytes(), "little") for row in np.packbits(graph, axis=1, bitorder="little")]
    best = _greedy(neighbours, core)
    best = _branch_and_bound(neighbours, best, max_steps)
    return np.sort(order[best])


def _degeneracy(adjacent: BoolArray) -> tuple[IntArray, IntArray]:
    """(N,) vertices in the order in which the one of least degree is taken away, and (N,) their core numbers."""
    degree = adjacent.sum(axis=1) - adjacent.diagonal()
    gone = len(adjacent) + 1
    order, core = np.zeros(len(adjacent), np.int64), np.zeros(len(adjacent), np.int64)
    for step in range(len(adjacent)):
        vertex = int(degree.argmin())
        order[step], core[step] = vertex, max(degree[vertex], core[step - 1] if step else 0)
        degree = degree - adjacent[vertex]
        degree[vertex] = gone * gone  # stays above the others however much is taken off
    return order, core


def _greedy(neighbours: list[int], core: IntArray) -> list[int]:
    """A clique from each vertex that could be in a larger one than the best so far, always adding the lowest bit."""
    best: list[int] = []
    for start in range(len(neighbours)):
        if core[start] < len(best):
            break  # they descend
        clique, candidates = [start], neighbours[start]
        while candidates:
            vertex = _lowest(candidates)
            clique.append(vertex)
            candidates &= neighbours[vertex]
        if len(clique) > len(best):
            best = clique
    return best


def _branch_and_bound(neighbours: list[int], best: list[int], max_steps: int) -> list[int]:
    """The largest clique, if it takes no more steps; else the largest found."""
    everything = (1 << len(neighbours)) - 1
    # A branch: the clique so far, and what may be added to it, each with a bound on how much that can become.
    stack: list[tuple[list[int], int, list[int], list[int]]] = [([], everything, *_coloured(everything, neighbours))]
    for _ in range(max_steps):
        if not stack:
            break
        clique, candidates, vertices, colours = stack[-1]
        if not vertices or len(clique) + colours[-1] <= len(best):
            stack.pop()
            continue
        vertex = vertices.pop()
        colours.pop()
        stack[-1] = (clique, candidates & ~(1 << vertex), vertices, colours)
        larger, remaining = [*clique, vertex], candidates & neighbours[vertex]
        if len(larger) > len(best):
            best = larger
        if remaining:
            stack.append((larger, remaining, *_coloured(remaining, neighbours)))
    return best


def _coloured(vertices: int, neighbours: list[int]) -> tuple[list[int], list[int]]:
    """The vertices, and of each its colour, 1 the first, ascending; adjacent ones differ.

    A clique has each colour at most once, so one among the first k of these vertices is no larger than the k-th's.
    """
    order, colours = [], []
    colour = 0
    while vertices:
        colour += 1
        free = vertices
        while free:
            vertex = _lowest(free)
            vertices ^= 1 << vertex
            free &= ~(neighbours[vertex] | 1 << vertex)
            order.append(vertex)
            colours.append(colour)
    return order, colours


def _lowest(bits: int) -> int:
    """Number of the lowest bit that is set."""
    return (bits & -bits).bit_length() - 1
