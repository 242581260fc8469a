"""What is true of the methods that share a map at stride 4."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cobevglue.fusion.coarse_map import CoarseMapFusion
from cobevglue.fusion.v2vnet import V2VNet
from cobevglue.fusion.v2vnet_robust import V2VNetRobust
from cobevglue.fusion.v2x_vit import V2XViT
from cobevglue.se2 import SE2

from . import checks

DETECTOR = checks.small_detector()

every_method = pytest.mark.parametrize("kind", [V2VNet, V2VNetRobust, V2XViT])


@every_method
def test_before_training_it_is_the_detector(kind: type[CoarseMapFusion]) -> None:
    seen = checks.view(DETECTOR, 0)
    with torch.inference_mode():
        output = checks.seeded(kind, DETECTOR)([checks.sample_of([seen])])
        expected = DETECTOR.decode_features([m[None] for m in seen.features])
    assert expected.logits.std() > 0.2
    torch.testing.assert_close(output.logits, expected.logits, atol=0.02, rtol=0.0)


@every_method
def test_message_has_quarter_cells_and_double_channels(kind: type[CoarseMapFusion]) -> None:
    rows, columns, _ = checks.SMALL.head_shape
    message = checks.seeded(kind, DETECTOR).message(checks.view(DETECTOR, 0))
    shapes = {name: values.shape for name, values in message.items()}
    assert shapes == {"map0": (2 * checks.SMALL.shrink_channels, rows // 2, columns // 2)}
    assert message["map0"].dtype == np.float16


def test_stride_4_cells_are_where_warping_expects() -> None:
    """A map at stride 2 turned by 180 degrees, then halved, is the halved one turned."""
    with torch.inference_mode():
        down = checks.seeded(V2VNet, DETECTOR).down
        kernel = next(down.parameters())
        kernel.copy_(kernel + kernel.flip(2, 3))  # turning leaves it as it is
        x = torch.randn(1, 8, 16, 32, generator=torch.Generator().manual_seed(0))
        torch.testing.assert_close(down(x.flip(2, 3)), down(x).flip(2, 3))


@every_method
def test_message_equals_training_input(kind: type[CoarseMapFusion]) -> None:
    ego, other = checks.view(DETECTOR, 0), checks.view(DETECTOR, 1)
    method = checks.seeded(kind, DETECTOR)
    method.up.weight.data.mul_(500.0)
    with torch.inference_mode():
        seen = method.fused([checks.sample_of([ego, other])])
        received = method.received_maps(checks.sent(method, other, checks.POSES[0]).content)
        own = method.share([m[None] for m in ego.features])
        maps = [torch.cat([mine, theirs[None]]) for mine, theirs in zip(own, received, strict=True)]
        over_the_wire = method._fuse(maps, [SE2(), checks.POSES[0]])
    for there, here in zip(over_the_wire, seen, strict=True):
        torch.testing.assert_close(there, here[0], atol=0.01, rtol=0.0)
