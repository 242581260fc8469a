"""What every aligner returns."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from cobevglue import SE2, BEVGlue, BEVGlueConfig
from cobevglue.alignment import ALIGNERS, Alignment, GroupAligner

from .scenes import pair_of_views


def test_an_alignment_with_a_pose_is_accepted() -> None:
    alignment = Alignment(SE2(1.0, 2.0, 0.3))
    assert alignment.accepted
    assert alignment.reason == ""


def test_refusal_has_reason_and_no_pose() -> None:
    alignment = Alignment.refused("too dark", evidence=3.0, margin=1.0)
    assert not alignment.accepted
    assert alignment.ego_SE2_other is None
    assert alignment.reason == "too dark"
    assert alignment.matches.shape == (0, 2)
    assert alignment.matches.dtype == np.int64
    assert np.diag(alignment.covariance).tolist() == [math.inf] * 3
    assert (alignment.evidence, alignment.margin) == (3.0, 1.0)


def test_unmeasured_evidence_is_unknown() -> None:
    refused = Alignment.refused("no reason")
    assert math.isnan(refused.evidence)
    assert math.isnan(refused.margin)


def test_two_refusals_share_no_arrays() -> None:
    a, b = Alignment.refused("a"), Alignment.refused("b")
    a.covariance[0, 0] = 1.0
    assert b.covariance[0, 0] == math.inf


def test_an_alignment_cannot_be_changed() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Alignment.refused("no").reason = "yes"  # type: ignore[misc]


@pytest.mark.usefixtures("warm_kernels")
@pytest.mark.parametrize("name", sorted(name for name, made in ALIGNERS.items() if not issubclass(made, GroupAligner)))
def test_registered_aligners_solve_an_easy_scene(name: str) -> None:
    scene = pair_of_views(common=10, seed=4)
    made = ALIGNERS[name]
    assert not issubclass(made, GroupAligner)
    aligner = made()
    alignment = aligner.align(scene.ego, scene.other)
    aligner.reset()
    assert alignment.ego_SE2_other is not None
    assert alignment.ego_SE2_other.error_to(scene.ego_SE2_other)[0] < 2.0


@pytest.mark.usefixtures("warm_kernels")
@pytest.mark.parametrize("config", [BEVGlueConfig(), BEVGlueConfig.paper()], ids=["robust", "paper"])
@pytest.mark.parametrize("common", range(6))
def test_reason_is_set_exactly_without_pose(config: BEVGlueConfig, common: int) -> None:
    scene = pair_of_views(common, seed=7, only_ego=2, only_other=3)
    alignment = BEVGlue(config).align(scene.ego, scene.other)
    assert alignment.accepted == (alignment.reason == "")
    assert alignment.accepted == bool(np.isfinite(alignment.covariance).all())
    assert alignment.accepted or len(alignment.matches) == 0
