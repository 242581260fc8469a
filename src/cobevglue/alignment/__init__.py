"""Sources of the relative pose between two agents."""

from __future__ import annotations

from functools import partial
from typing import Any

from cobevglue.alignment.alignment import Aligner, Alignment
from cobevglue.alignment.bevglue import BEVGlue
from cobevglue.alignment.bevglue_group import BEVGlueGroup
from cobevglue.alignment.config import AffinityConfig, BEVGlueConfig
from cobevglue.alignment.given import GivenLocalisation
from cobevglue.alignment.group import GroupAligner, Observation, Pairwise
from cobevglue.alignment.hypotheses import PoseHypothesis
from cobevglue.alignment.levelling import Levelling, LevellingConfig, LevellingFilter, estimate_levelling
from cobevglue.alignment.max_consensus import MaximumConsensus
from cobevglue.alignment.pose_graph import CoAlign
from cobevglue.alignment.registration import ICP2D, ICP3D, FPFHTeaser
from cobevglue.alignment.v2vnet_robust import V2VNetRobustPoses
from cobevglue.datasets.frame import did_you_mean

__all__ = [
    "ALIGNERS",
    "AffinityConfig",
    "Aligner",
    "Alignment",
    "BEVGlue",
    "BEVGlueConfig",
    "BEVGlueGroup",
    "GroupAligner",
    "Levelling",
    "LevellingConfig",
    "LevellingFilter",
    "Observation",
    "PoseHypothesis",
    "estimate_levelling",
    "group_aligner",
]

ALIGNERS: dict[str, type[Aligner] | type[GroupAligner]] = {
    "bevglue": BEVGlue,
    "bevglue-group": BEVGlueGroup,
    "given": GivenLocalisation,
    "coalign": CoAlign,
    "fpv-rcnn": MaximumConsensus,
    "icp-2d": ICP2D,
    "icp-3d": ICP3D,
    "fpfh-teaser": FPFHTeaser,
    "v2vnet-robust": V2VNetRobustPoses,
}
"""From the name users type to the class: an `Aligner` uses the boxes of two agents, a `GroupAligner` what its
`needs` lists, of all agents."""


def group_aligner(name: str, **options: Any) -> GroupAligner:
    """The aligner of this name, for all collaborators of an ego.

    Args:
        name: in `ALIGNERS`.
        options: arguments of the class.

    Raises:
        ValueError: there is none; names the nearest.
    """
    if name not in ALIGNERS:
        raise ValueError(f"no aligner {did_you_mean(name, ALIGNERS)}")
    made = ALIGNERS[name]
    if issubclass(made, GroupAligner):
        return made(**options)
    return Pairwise(partial(made, **options))
