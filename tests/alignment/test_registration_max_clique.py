"""The largest clique, against trying all subsets."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue.alignment.registration.max_clique import max_clique
from cobevglue.typing import BoolArray


def graph(n: int, share: float, seed: int) -> BoolArray:
    upper = np.triu(np.random.default_rng([seed, n, 0]).random((n, n)) < share, 1)
    return np.asarray(upper | upper.T)


def is_clique(adjacent: BoolArray, vertices: Sequence[int]) -> bool:
    return all(adjacent[i, j] for i, j in itertools.combinations(vertices, 2))


def largest_by_trying_all(adjacent: BoolArray) -> int:
    n = len(adjacent)
    sizes = (
        len(some) for k in range(n + 1) for some in itertools.combinations(range(n), k) if is_clique(adjacent, some)
    )
    return max(sizes)


@given(seed=st.integers(0, 10**6), n=st.integers(0, 10), share=st.floats(0.0, 1.0))
@settings(max_examples=60, deadline=None)
def test_it_is_a_clique_and_none_is_larger(seed: int, n: int, share: float) -> None:
    adjacent = graph(n, share, seed)
    found = max_clique(adjacent).tolist()
    assert is_clique(adjacent, found)
    assert found == sorted(set(found))
    assert len(found) == largest_by_trying_all(adjacent)


@pytest.mark.parametrize(("n", "share", "planted"), [(300, 0.05, 15), (300, 0.3, 40), (700, 0.02, 12)])
def test_a_planted_clique_is_found(n: int, share: float, planted: int) -> None:
    adjacent = graph(n, share, 1)
    members = np.sort(np.random.default_rng([2, 0, 0]).choice(n, planted, replace=False))
    adjacent[np.ix_(members, members)] = ~np.eye(planted, dtype=bool)
    assert set(members.tolist()) <= set(max_clique(adjacent).tolist())


def test_greed_alone_is_not_enough() -> None:
    """The three highest-degree vertices form a triangle full of leaves; the largest clique, of four, stands apart."""
    adjacent = np.zeros((40, 40), dtype=bool)
    for i, j in [(0, 1), (0, 2), (1, 2), *((hub, 3 + 10 * hub + k) for hub in range(3) for k in range(10))]:
        adjacent[i, j] = adjacent[j, i] = True
    four = [35, 36, 37, 38]
    adjacent[np.ix_(four, four)] = ~np.eye(4, dtype=bool)
    assert max_clique(adjacent).tolist() == four


def test_out_of_steps_it_is_still_a_clique() -> None:
    adjacent = graph(120, 0.7, 4)
    hasty, thorough = max_clique(adjacent, max_steps=1), max_clique(adjacent)
    assert is_clique(adjacent, hasty.tolist())
    assert 5 < len(hasty) <= len(thorough)


def test_clique_is_deterministic_and_leaves_graph_unchanged() -> None:
    adjacent = graph(80, 0.4, 5)
    np.fill_diagonal(adjacent, True)
    before = adjacent.copy()
    assert max_clique(adjacent).tolist() == max_clique(adjacent).tolist()
    np.testing.assert_array_equal(adjacent, before)
