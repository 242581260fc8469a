"""Sources of the relative pose between two agents."""

from __future__ import annotations

from functools import partial
from typing import Any

from cobevglue.alignment.alignment import Aligner, Alignment
from cobevglue.alignment.bevglue import BEVGlue
from cobevglue.alignment.config import AffinityConfig, BEVGlueConfig
from cobevglue.alignment.given import GivenLocalisation
from cobevglue.alignment.group import GroupAligner, Observation, Pairwise
from cobevglue.datasets.frame import did_you_mean

__all__ = [
    "ALIGNERS",
    "AffinityConfig",
    "Aligner",
    "Alignment",
    "BEVGlue",
    "BEVGlueConfig",
    "GroupAligner",
    "Observation",
    "group_aligner",
]

ALIGNERS: dict[str, type[Aligner] | type[GroupAligner]] = {
    "bevglue": BEVGlue,
    "given": GivenLocalisation,
}
"""From the name users type to the class: an `Aligner` looks at the boxes of two agents, a `GroupAligner` at what it
says it needs of all of them."""


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
