"""Disturbances, seeded per sample: detection errors, localisation noise and attacks, late and lost messages."""

from __future__ import annotations

from typing import Any

from cobevglue.datasets.frame import did_you_mean
from cobevglue.disturbance.disturbance import Disturbance, ObservedFrame, Undisturbed
from cobevglue.disturbance.localisation import LocalisationNoise, OffsetPose, ReplayedPose, SamePlace
from cobevglue.disturbance.messages import Delay, FabricatedBoxes, MessageLoss

__all__ = [
    "DISTURBANCES",
    "Delay",
    "Disturbance",
    "FabricatedBoxes",
    "LocalisationNoise",
    "MessageLoss",
    "ObservedFrame",
    "OffsetPose",
    "ReplayedPose",
    "SamePlace",
    "Undisturbed",
    "disturbance",
]

DISTURBANCES: dict[str, type[Disturbance]] = {
    "none": Undisturbed,
    "noise": LocalisationNoise,
    "same-place": SamePlace,
    "replay": ReplayedPose,
    "offset": OffsetPose,
    "fabricated": FabricatedBoxes,
    "loss": MessageLoss,
    "delay": Delay,
}
"""From the name users type to the class."""


def disturbance(name: str, **options: Any) -> Disturbance:
    """The disturbance of this name.

    Args:
        name: in `DISTURBANCES`.
        options: its settings.

    Raises:
        ValueError: there is no such disturbance or setting (names the nearest), or a value is out of its range.
    """
    if name not in DISTURBANCES:
        raise ValueError(f"no disturbance {did_you_mean(name, DISTURBANCES)}")
    return DISTURBANCES[name](**options)
