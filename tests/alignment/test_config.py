"""The settings: what is refused, and by which name."""

from __future__ import annotations

import math

import pytest
from pydantic import ValidationError

from cobevglue import BEVGlueConfig
from cobevglue.alignment import AffinityConfig


@pytest.mark.parametrize("config", [BEVGlueConfig, AffinityConfig])
def test_unknown_field_is_named(config: type[BEVGlueConfig] | type[AffinityConfig]) -> None:
    with pytest.raises(ValidationError, match="one_to_won"):
        config.model_validate({"one_to_won": True})


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("method", "magic"),
        ("position_std", 0.0),
        ("position_std", -0.1),
        ("position_std", math.nan),
        ("position_std", math.inf),
        ("heading_std", "wide"),
        ("density", 0.0),
        ("flip_probability", 0.0),
        ("flip_probability", 1.0),
        ("memory", 1.0),
        ("memory", -0.5),
        ("absence", -1.0),
        ("chance_evidence", math.inf),
        ("tries", 0),
        ("rounds", 0),
        ("tries", 2.5),
        ("max_gap", 0.0),
        ("sizes", "perhaps"),
        ("affinity", {"node_threshold": 1.5}),
    ],
)
def test_out_of_range_value_is_named(field: str, value: object) -> None:
    with pytest.raises(ValidationError, match=field):
        BEVGlueConfig.model_validate({field: value})


def test_affinities_are_settings_of_their_own() -> None:
    with pytest.raises(ValidationError, match="AffinityConfig has no setting 'gamma'"):
        BEVGlueConfig.model_validate({"affinity": {"gamma": 0.5}})
    assert BEVGlueConfig.model_validate({"affinity": {"node_threshold": 0.5}}).affinity.node_threshold == 0.5


@pytest.mark.parametrize("config", [BEVGlueConfig(), BEVGlueConfig.paper()], ids=["robust", "paper"])
def test_settings_survive_a_file_and_cannot_be_changed(config: BEVGlueConfig) -> None:
    assert BEVGlueConfig.model_validate_json(config.model_dump_json()) == config
    with pytest.raises(ValidationError, match="frozen"):
        config.verdict = False


def test_paper_preset_uses_affinity_without_verdict() -> None:
    paper = BEVGlueConfig.paper()
    assert paper.method == "affinity"
    assert not paper.verdict
    assert BEVGlueConfig().method == "evidence"
