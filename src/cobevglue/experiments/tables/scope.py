"""The scope of a study, the conditions that several tables share, and the titles of rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from cobevglue.alignment import ALIGNERS
from cobevglue.alignment.group import GroupAligner, Need
from cobevglue.experiments.condition import Condition
from cobevglue.experiments.measure import Results
from cobevglue.experiments.table import Table
from cobevglue.fusion import FUSION_METHODS

__all__ = [
    "FULL",
    "PAPERS",
    "QUICK",
    "Experiment",
    "Scope",
    "aligner_title",
    "as_is",
    "attacked",
    "level_name",
    "method_title",
    "needs",
]

_METHOD_TITLES = {
    "none": "No collaboration",
    "late": "Late fusion",
    "early": "Early fusion",
    "f-cooper": "F-Cooper",
    "v2vnet": "V2VNet",
    "disconet": "DiscoNet",
    "where2comm": "Where2comm",
    "fpv-rcnn": "FPV-RCNN",
    "v2vnet-robust": "V2VNet-robust",
    "v2x-vit": "V2X-ViT",
    "coalign": "CoAlign",
    "cobevglue-features": "CoBEVGlue, features only",
    "cobevglue": "CoBEVGlue",
}
_ALIGNER_TITLES = {
    "given": "given pose",
    "bevglue": "BEVGlue",
    "coalign": "CoAlign's pose graph",
    "fpv-rcnn": "FPV-RCNN's correction",
    "v2vnet-robust": "V2VNet-robust's correction",
    "icp-2d": "ICP 2-D",
    "icp-3d": "ICP 3-D",
    "fpfh-teaser": "FPFH + TEASER",
}

_ALWAYS = ("none", "cobevglue-features", "cobevglue")


@dataclass(frozen=True)
class Scope:
    """The range of conditions.

    Attributes:
        levels: of localisation noise, standard deviations in metres and in degrees; from none to strong.
        registration_levels: the same, for the initial poses of registration.
        budgets: what a collaborator may send for registration in a frame [bytes].
        registration_every: registration is run on every so many frames.
        compressions: of transmitted features, (bits of a number, share of the cells that are sent).
        bandwidth_every: the methods that trust poses are compressed on every so many frames.
        trusting_every: how often the methods that trust poses are run under further disturbances, as this is their own
            table's only and they do not remember.
        only: fusion methods to be compared with no collaboration and CoBEVGlue; None for all.
    """

    levels: Sequence[float] = (0.0, 0.5, 1.5, 2.5)
    registration_levels: Sequence[float] = (0.5, 1.5, 2.5)
    budgets: Sequence[int] = (1_000, 8_000, 64_000)
    registration_every: int = 4
    compressions: Sequence[tuple[int, float]] = ((8, 1.0), (4, 1.0), (3, 0.3), (3, 0.05), (3, 0.01))
    bandwidth_every: int = 4
    trusting_every: int = 4
    only: Sequence[str] | None = None

    @property
    def methods(self) -> list[str]:
        """The fusion methods, in the order of the paper's Table 1."""
        return [name for name in FUSION_METHODS if self.only is None or name in (*self.only, *_ALWAYS)]

    @property
    def trusting(self) -> list[str]:
        """The collaborative methods with poses from localisation, corrected or not."""
        return [name for name in self.methods if name != "none" and FUSION_METHODS[name].usual_aligner != "bevglue"]

    @property
    def localised(self) -> list[str]:
        """The methods that need no pose: CoBEVGlue's two."""
        return [name for name in self.methods if FUSION_METHODS[name].usual_aligner == "bevglue"]

    @property
    def ours(self) -> str:
        """The method of the tables on one method: CoBEVGlue as it is by default."""
        return "cobevglue"

    @property
    def registrations(self) -> list[str]:
        """The aligners that use points."""
        return [name for name in ALIGNERS if needs(name, "points")]


FULL = Scope()
QUICK = Scope(
    levels=(0.0, 2.5),
    registration_levels=(0.5,),
    budgets=(8_000,),
    registration_every=6,
    compressions=((3, 0.05),),
    bandwidth_every=3,
    trusting_every=3,
)
"""A smoke test that takes minutes."""


@dataclass(frozen=True)
class Experiment:
    """A group of tables.

    Attributes:
        name: short, as users type it.
        title: heading.
        text: what was done, one paragraph.
        conditions: what is to be run for it.
        tables: made of the results; the name of the data set says whether there are numbers of the paper.
    """

    name: str
    title: str
    text: str
    conditions: Callable[[Scope], list[Condition]]
    tables: Callable[[Scope, Results, str], list[Table]]


def as_is(fusion: str, level: float = 0.0, aligner: str | None = None, **more: Any) -> Condition:
    """A method with the aligner of its paper, or another one, at a level of noise [m, degrees]."""
    used = aligner or FUSION_METHODS[fusion].usual_aligner
    if level == 0.0:
        return Condition(fusion=fusion, aligner=used, **more)
    noise = {"position": level, "yaw": level}
    return Condition(fusion=fusion, aligner=used, disturbance="noise", disturbance_options=noise, **more)


def attacked(fusion: str, aligner: str | None = None) -> Condition:
    """A method with the aligner of its paper, or another one, under the attack of the paper."""
    return as_is(fusion, 0.0, aligner, disturbance="same-place")


def needs(aligner: str, what: Need) -> bool:
    """Whether an aligner uses data of this kind."""
    kind = ALIGNERS[aligner]
    return what in kind.needs if issubclass(kind, GroupAligner) else what == "boxes"


PAPERS = (
    "Paper: its own figures, on the whole test split, with a detector that was trained on this data set and looks "
    "farther; compare the order of the rows, and how they fall.",
)
"""A note below tables with the paper's figures."""


def level_name(level: float) -> str:
    """A noise level in the notation of the paper."""
    return f"{level:.1f}/{level:.1f}"


def method_title(name: str) -> str:
    """The name of a fusion method in the literature."""
    return _METHOD_TITLES.get(name, name)


def aligner_title(name: str) -> str:
    """The title of a source of poses."""
    return _ALIGNER_TITLES.get(name, name)
