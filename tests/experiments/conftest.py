"""The data and the detector of most tests here, written once."""

from __future__ import annotations

from pathlib import Path

import pytest

from .tiny import tiny_detector, tiny_tree


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `data` and `tiny.safetensors`; not to be written to."""
    folder = tmp_path_factory.mktemp("tiny")
    tiny_tree(folder / "data")
    tiny_detector(folder)
    return folder
