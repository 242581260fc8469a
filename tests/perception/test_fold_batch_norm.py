"""Batch normalisation folded into convolutions."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from cobevglue.fusion import pretrained_fusion
from cobevglue.perception import PointPillars
from cobevglue.perception.fold_batch_norm import fold_batch_norm


def test_folded_detector_gives_the_same_maps() -> None:
    detector = PointPillars.pretrained("compact")
    config = detector.config
    image = torch.rand(1, config.pillar_channels, config.rows, config.columns, generator=torch.manual_seed(0))
    folded = fold_batch_norm(detector)
    with torch.inference_mode():
        expected = detector.decode_features(detector.multiscale(image))
        found = folded.decode_features(folded.multiscale(image))
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in folded.modules())
    assert any(isinstance(module, nn.BatchNorm2d) for module in detector.modules()), "the detector is unchanged"


def test_fusion_method_keeps_its_settings() -> None:
    detector = PointPillars.pretrained("compact")
    method = pretrained_fusion("cobevglue", detector, "compact")
    assert isinstance(method, nn.Module)
    folded = fold_batch_norm(method)
    assert type(folded) is type(method)
    assert folded.state_dict().keys() < method.state_dict().keys() | {
        f"{name}.bias" for name, module in folded.named_modules() if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d))
    }


def test_network_in_training_mode_is_an_error() -> None:
    with pytest.raises(ValueError, match="evaluation mode"):
        fold_batch_norm(nn.Sequential(nn.Conv2d(1, 1, 1), nn.BatchNorm2d(1)))
