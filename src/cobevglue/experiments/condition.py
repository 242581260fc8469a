"""A condition of a study: a fusion method, a source of poses and a disturbance."""

from __future__ import annotations

import json
from typing import Annotated, Any

from pydantic import Field

from cobevglue.alignment import ALIGNERS
from cobevglue.datasets.frame import did_you_mean
from cobevglue.disturbance import Disturbance, disturbance
from cobevglue.fusion import Compression
from cobevglue.settings import Settings

__all__ = ["Condition"]


class Condition(Settings):
    """How the system is run. Equal conditions have equal keys in all processes.

    Attributes:
        fusion: name of the fusion method.
        aligner: name of the source of poses.
        aligner_options: its arguments; of "bevglue", fields of `BEVGlueConfig`.
        disturbance: name of the disturbance.
        disturbance_options: its settings.
        true_poses: aligners that need poses use the true ones instead of the claimed ones: the oracle.
        forget: the aligner is reset before each frame.
        every: step between the frames that are run.
        compression: of the transmitted features; None for none.

    Raises:
        ValueError: no such aligner, disturbance or option (names the nearest), or a value out of its range.
    """

    fusion: str
    aligner: str
    aligner_options: dict[str, Any] = Field(default_factory=dict)
    disturbance: str = "none"
    disturbance_options: dict[str, float] = Field(default_factory=dict)
    true_poses: bool = False
    forget: bool = False
    every: Annotated[int, Field(ge=1)] = 1
    compression: Compression | None = None

    def model_post_init(self, _: Any) -> None:
        """Check that the condition can be run."""
        if self.aligner not in ALIGNERS:
            raise ValueError(f"no aligner {did_you_mean(self.aligner, ALIGNERS)}")
        self.make_disturbance()

    @property
    def key(self) -> str:
        """All fields as one line of JSON."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True)

    def make_disturbance(self) -> Disturbance:
        """The disturbance of this condition."""
        return disturbance(self.disturbance, **self.disturbance_options)
