"""The registry, and that importing it stays cheap."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from cobevglue.datasets import DAIRV2X, DATASETS, OPV2V, V2V4Real, V2XSet


def test_the_names_that_users_type() -> None:
    assert {"opv2v": OPV2V, "v2xset": V2XSet, "v2v4real": V2V4Real, "dair-v2x": DAIRV2X} == DATASETS


def test_data_set_is_made_from_root_and_split(tmp_path: Path) -> None:
    for data_set in DATASETS.values():
        with pytest.raises(FileNotFoundError, match=str(tmp_path)):
            data_set(tmp_path / "nothing", "train")


def test_importing_readers_loads_no_torch_or_pypcd4() -> None:
    script = (
        "import sys, cobevglue.datasets; print([m for m in ('torch', 'pypcd4', 'scipy', 'numba') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60)
    assert out.stdout.strip() == "[]"
