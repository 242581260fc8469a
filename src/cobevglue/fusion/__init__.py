"""Fusion methods: one file for each method of the paper's tables."""

from __future__ import annotations

from pathlib import Path

from cobevglue.datasets.frame import did_you_mean
from cobevglue.fusion.coalign import CoAlign
from cobevglue.fusion.cobevglue import MaxFusion, MaxFusionWithBoxes
from cobevglue.fusion.compression import CompressedFusion, Compression
from cobevglue.fusion.disconet import DiscoNet
from cobevglue.fusion.early import EarlyFusion
from cobevglue.fusion.f_cooper import FCooper
from cobevglue.fusion.fpv_rcnn import FPVRCNN
from cobevglue.fusion.intermediate import FusionSample, IntermediateFusion, MultiScaleFusion, SingleMapFusion
from cobevglue.fusion.late import LateFusion
from cobevglue.fusion.method import FusionMethod, Received
from cobevglue.fusion.none import NoCollaboration
from cobevglue.fusion.v2vnet import V2VNet
from cobevglue.fusion.v2vnet_robust import V2VNetRobust
from cobevglue.fusion.v2x_vit import V2XViT
from cobevglue.fusion.where2comm import Where2comm
from cobevglue.perception import PointPillars

__all__ = [
    "FUSION_METHODS",
    "CompressedFusion",
    "Compression",
    "FusionMethod",
    "FusionSample",
    "IntermediateFusion",
    "MultiScaleFusion",
    "Received",
    "SingleMapFusion",
    "fusion_class",
    "pretrained_fusion",
    "weights_name",
]

FUSION_METHODS: dict[str, type[FusionMethod]] = {
    "none": NoCollaboration,
    "late": LateFusion,
    "early": EarlyFusion,
    "f-cooper": FCooper,
    "v2vnet": V2VNet,
    "disconet": DiscoNet,
    "where2comm": Where2comm,
    "fpv-rcnn": FPVRCNN,
    "v2vnet-robust": V2VNetRobust,
    "v2x-vit": V2XViT,
    "coalign": CoAlign,
    "cobevglue-features": MaxFusion,
    "cobevglue": MaxFusionWithBoxes,
}
"""From the name users type to the class, in the order of the paper's Table 1, the last two of which are its one row."""

_SHARED_WEIGHTS = {"cobevglue-features": "cobevglue"}
"""Methods that use the weights of another one."""

_WEIGHTS = Path(__file__).parent / "weights"


def fusion_class(name: str) -> type[FusionMethod]:
    """The class of this name in `FUSION_METHODS`.

    Raises:
        ValueError: there is none; names the nearest.
    """
    if name not in FUSION_METHODS:
        raise ValueError(f"no fusion method {did_you_mean(name, FUSION_METHODS)}")
    return FUSION_METHODS[name]


def weights_name(name: str) -> str:
    """The name of the method whose weights a method uses, in most cases its own."""
    return _SHARED_WEIGHTS.get(name, name)


def pretrained_fusion(name: str, detector: PointPillars, detector_name: str) -> FusionMethod:
    """A method, with the weights that come with the package where it has any.

    Args:
        name: of the method.
        detector: the encoder that it was trained on.
        detector_name: its name among the pretrained.

    Raises:
        ValueError: there is no such method; or there are no weights of it for this detector.
    """
    method = fusion_class(name)(detector)
    if isinstance(method, IntermediateFusion):
        path = _WEIGHTS / f"{detector_name}_{weights_name(name)}.safetensors"
        if not path.is_file():
            raise ValueError(f"no pretrained weights of {name!r} for the detector {detector_name!r}")
        method.load(path)
    return method
