"""The networks of a study, built once per process."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import nn

from cobevglue.alignment import BEVGlueConfig, group_aligner
from cobevglue.alignment.group import GroupAligner
from cobevglue.experiments.condition import Condition
from cobevglue.experiments.study import StudySettings
from cobevglue.fusion import (
    CompressedFusion,
    FusionMethod,
    IntermediateFusion,
    fusion_class,
    pretrained_fusion,
    weights_name,
)
from cobevglue.perception import PointPillars
from cobevglue.perception.checkpoint import fingerprint
from cobevglue.torch_device import chosen_device

__all__ = ["Models"]

_WITH_NETWORK = {"v2vnet-robust"}
"""Aligners that use the network of the fusion method of the same name."""


class Models:
    """The detector and the fusion methods of a study.

    Args:
        settings: of the study.

    Attributes:
        detector: in evaluation mode, on a GPU where there is one.

    Raises:
        ValueError: no such detector (names the nearest), or a damaged file.
        FileNotFoundError: there is no such file.
    """

    def __init__(self, settings: StudySettings) -> None:
        self._settings = settings
        self.detector = PointPillars.named(settings.detector).to(chosen_device())
        self._methods: dict[str, FusionMethod] = {}
        self._fingerprints: dict[str, str] = {}

    @property
    def evaluation_range(self) -> tuple[float, float, float, float]:
        """x_min, x_max, y_min, y_max [m]: the detector's range less one pillar, in whole metres."""
        config = self.detector.config
        inside = 1e-6 - config.pillar
        (x_min, x_max), (y_min, y_max) = config.x_range, config.y_range
        return (
            -math.floor(inside - x_min),
            math.floor(inside + x_max),
            -math.floor(inside - y_min),
            math.floor(inside + y_max),
        )

    def method(self, name: str) -> FusionMethod:
        """The fusion method of this name.

        Raises:
            ValueError: there is none, or it has no weights for this detector.
            FileNotFoundError: the folder of weights does not have them.
        """
        if name not in self._methods:
            method = self._make(name)
            if isinstance(method, nn.Module):
                method.to(self.detector.device).eval()
            self._methods[name] = method
        return self._methods[name]

    def fusion(self, condition: Condition) -> FusionMethod:
        """The fusion method of a condition, with its compression.

        Raises:
            ValueError: as `method`; or its messages cannot be compressed so.
        """
        method = self.method(condition.fusion)
        return method if condition.compression is None else CompressedFusion(method, condition.compression)

    def _make(self, name: str) -> FusionMethod:
        settings = self._settings
        if not settings.untrained and settings.weights is None:
            return pretrained_fusion(name, self.detector, settings.detector)
        with torch.random.fork_rng(devices=[]):  # untrained weights are the same in all processes
            torch.manual_seed(settings.seed)
            method = fusion_class(name)(self.detector)
        if isinstance(method, IntermediateFusion) and settings.weights is not None:
            method.load(Path(settings.weights) / f"{weights_name(name)}.safetensors")
        return method

    def aligner(self, condition: Condition) -> GroupAligner:
        """A new aligner for a condition; one with a network uses that of this study.

        Raises:
            ValueError: it does not take the condition's options.
            ModuleNotFoundError: a required package is not installed.
        """
        if condition.aligner in _WITH_NETWORK:
            network = self.method(condition.aligner)
            return group_aligner(condition.aligner, fusion=network, **condition.aligner_options)
        if condition.aligner == "bevglue":
            return group_aligner("bevglue", config=BEVGlueConfig(**condition.aligner_options))
        return group_aligner(condition.aligner, **condition.aligner_options)

    def fingerprint(self, condition: Condition) -> str:
        """Fingerprint of the weights that a condition uses; it changes with them."""
        names = [condition.fusion, *({condition.aligner} & _WITH_NETWORK - {condition.fusion})]
        return "-".join(self._fingerprint_of(name) for name in names)

    def _fingerprint_of(self, name: str) -> str:
        if name not in self._fingerprints:
            method = self.method(name)
            self._fingerprints[name] = fingerprint(method if isinstance(method, nn.Module) else self.detector)
        return self._fingerprints[name]

    @property
    def detector_fingerprint(self) -> str:
        """Fingerprint of the detector's weights."""
        return fingerprint(self.detector)
