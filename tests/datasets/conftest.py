"""The folder of real files that some tests run on; they skip where it is absent."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[2]


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
