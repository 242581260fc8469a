"""Files that several tests read: the folder of real ones, where it is there, and trees made here."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from cobevglue.datasets import write_opv2v_frame
from cobevglue.simulation import Junction, JunctionSettings

PROJECT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def real_data() -> Path:
    folder = Path(os.environ.get("COBEVGLUE_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data: set COBEVGLUE_DATA (looked for {folder})")
    return folder


@pytest.fixture(scope="session")
def culver_city(real_data: Path) -> Path:
    root = real_data / "opv2v"
    if not (root / "test_culvercity").is_dir():
        pytest.skip(f"no OPV2V files in {real_data}")
    return root


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
