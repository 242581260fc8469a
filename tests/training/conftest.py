"""Settings of a run that takes a second."""

from __future__ import annotations

import pytest

pytest.importorskip("torch")

from cobevglue.training import TrainDetectorConfig, load_config

from .small import SMALL


@pytest.fixture
def config() -> TrainDetectorConfig:
    return load_config("tiny", SMALL)
