"""Compiles the kernels once, before the first test that needs them, so that no single test takes the blame."""

from __future__ import annotations

import pytest

from cobevglue import BEVGlue

from .scenes import pair_of_views


@pytest.fixture(scope="session")
def warm_kernels() -> None:
    glue = BEVGlue()
    scene = pair_of_views(common=5, seed=0)
    for _ in range(2):
        glue.align(scene.ego, scene.other)
