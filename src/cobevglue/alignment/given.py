"""Localisation as it is given: what all methods without an aligner of their own trust."""

from __future__ import annotations

from collections.abc import Mapping

from cobevglue.alignment.alignment import Alignment
from cobevglue.alignment.group import GroupAligner, Observation
from cobevglue.datasets.poses import inverse_SE3
from cobevglue.se2 import SE2

__all__ = ["GivenLocalisation"]


class GivenLocalisation(GroupAligner):
    """The relative pose of two claimed poses, never refused. Exact, noisy or attacked: as the claims are."""

    needs = frozenset({"pose"})

    def align_group(
        self, ego: str, observations: Mapping[str, Observation], time: float | None = None
    ) -> dict[str, Alignment]:
        """`inverse(world_SE3_ego) @ world_SE3_other`, its planar part."""
        own = observations[ego].pose
        assert own is not None
        ego_SE3_world = inverse_SE3(own)
        return {
            name: Alignment(SE2.from_matrix(ego_SE3_world @ other.pose))
            for name, other in observations.items()
            if name != ego and other.pose is not None
        }
