"""Trees of files that several tests read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cobevglue.datasets import write_opv2v_frame
from cobevglue.simulation import Junction, JunctionSettings


@pytest.fixture(scope="session")
def junction_tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve frames of a junction in OPV2V's format, test/junction_0002/{0,1}, labels only; not to be written to."""
    root = tmp_path_factory.mktemp("junction")
    for index, frame in enumerate(Junction(2, JunctionSettings(agents=2, duration=1.2))):
        for number, view in enumerate(frame.agents.values()):
            pose = np.eye(4)
            c, s = np.cos(view.world_SE2_agent.yaw), np.sin(view.world_SE2_agent.yaw)
            pose[:2, :2] = [[c, -s], [s, c]]
            pose[:3, 3] = view.world_SE2_agent.x, view.world_SE2_agent.y, 1.9
            folder = root / "test" / "junction_0002" / str(number)
            write_opv2v_frame(folder, f"{2 * index:06d}", pose, view.visible)
    return root
