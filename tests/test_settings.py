"""Settings: what is unknown or out of range is named."""

from __future__ import annotations

import pytest

from cobevglue import BEVGlueConfig
from cobevglue.disturbance.detection_errors import DetectionErrors
from cobevglue.settings import Settings
from cobevglue.simulation import JunctionSettings
from cobevglue.tracking import SortConfig


@pytest.mark.parametrize(
    ("settings", "wrong", "meant"),
    [
        (BEVGlueConfig, "tolernce", "tolerance"),
        (DetectionErrors, "yaw_sd", "yaw_std"),
        (JunctionSettings, "agent", "agents"),
        (SortConfig, "max_ages", "max_age"),
    ],
)
def test_an_unknown_name_gets_the_nearest_valid_one(settings: type[Settings], wrong: str, meant: str) -> None:
    with pytest.raises(ValueError, match=f"{settings.__name__} has no setting '{wrong}'; did you mean '{meant}'"):
        settings(**{wrong: 1})


def test_settings_do_not_change() -> None:
    with pytest.raises(ValueError, match="frozen"):
        BEVGlueConfig().tries = 3
