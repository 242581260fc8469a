"""Sources of the relative pose between two agents. All share the `Aligner` protocol."""

from cobevglue.alignment.alignment import Aligner, Alignment
from cobevglue.alignment.bevglue import BEVGlue
from cobevglue.alignment.config import AffinityConfig, BEVGlueConfig

__all__ = ["ALIGNERS", "AffinityConfig", "Aligner", "Alignment", "BEVGlue", "BEVGlueConfig"]

ALIGNERS: dict[str, type[Aligner]] = {"bevglue": BEVGlue}
"""From the name users type to the class."""
