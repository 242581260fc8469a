"""The tables of the paper and further ones: for each the conditions to run, and the table made of the results."""

from __future__ import annotations

from collections.abc import Sequence

from cobevglue.datasets.frame import did_you_mean
from cobevglue.experiments.condition import Condition
from cobevglue.experiments.tables.ablation import ABLATION
from cobevglue.experiments.tables.attack import ATTACK_TABLE
from cobevglue.experiments.tables.bandwidth import BANDWIDTH
from cobevglue.experiments.tables.cost import COMMUNICATION, TIME
from cobevglue.experiments.tables.disturbances import FURTHER
from cobevglue.experiments.tables.noise import NOISE
from cobevglue.experiments.tables.pose import POSE
from cobevglue.experiments.tables.registration import REGISTRATION
from cobevglue.experiments.tables.scope import FULL, QUICK, Experiment, Scope

__all__ = ["EXPERIMENTS", "FULL", "QUICK", "Experiment", "Scope", "conditions_of", "experiments_named"]

EXPERIMENTS: dict[str, Experiment] = {
    experiment.name: experiment
    for experiment in (NOISE, ATTACK_TABLE, REGISTRATION, ABLATION, FURTHER, POSE, COMMUNICATION, BANDWIDTH, TIME)
}
"""By the name that users type, in the order of the report."""


def experiments_named(names: Sequence[str]) -> list[Experiment]:
    """The experiments of these names, in the order of the report.

    Raises:
        ValueError: there is none of a name; names the nearest.
    """
    for name in names:
        if name not in EXPERIMENTS:
            raise ValueError(f"no table {did_you_mean(name, EXPERIMENTS)}")
    return [experiment for name, experiment in EXPERIMENTS.items() if name in names]


def conditions_of(experiments: Sequence[Experiment], scope: Scope) -> list[Condition]:
    """All conditions of these experiments, without duplicates."""
    conditions = [condition for experiment in experiments for condition in experiment.conditions(scope)]
    return list({condition.key: condition for condition in conditions}.values())
