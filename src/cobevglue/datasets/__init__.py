"""Data sets of collaborative perception with a common `Frame` interface, and text files of tracking.

    for frame in OPV2V(root, split="test_culvercity")["TwoCars_1"]:
        frame.agents["car1"].points           # (N, 4) x, y, z, intensity, the agent's LiDAR frame
        frame.agents["car1"].world_SE3_lidar  # (4, 4)
        frame.agents["car1"].objects          # Boxes, the agent's LiDAR frame

All coordinates are right-handed (x forward, y left, z up), also where the files are not. Files are read lazily.
"""

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cobevglue.datasets.dair_v2x import DAIRV2X
from cobevglue.datasets.dair_v2x_writer import (
    DAIRPair,
    DAIRSide,
    write_dair_v2x_frame,
    write_dair_v2x_index,
)
from cobevglue.datasets.frame import AgentFrame, Dataset, Frame, Scenario, did_you_mean
from cobevglue.datasets.opv2v import OPV2V, V2XSet
from cobevglue.datasets.opv2v_writer import write_opv2v_frame
from cobevglue.datasets.pcd import read_pcd
from cobevglue.datasets.poses import transform_boxes
from cobevglue.datasets.v2v4real import V2V4Real
from cobevglue.datasets.v2v4real_writer import write_v2v4real_frame

DATASETS: dict[str, type[Dataset]] = {"opv2v": OPV2V, "v2xset": V2XSet, "v2v4real": V2V4Real, "dair-v2x": DAIRV2X}
"""Data set classes by command-line name; all take (root, split)."""

__all__ = [
    "DAIRV2X",
    "DATASETS",
    "OPV2V",
    "AgentFrame",
    "DAIRPair",
    "DAIRSide",
    "Dataset",
    "Frame",
    "Scenario",
    "V2V4Real",
    "V2XSet",
    "open_dataset",
    "read_pcd",
    "transform_boxes",
    "write_dair_v2x_frame",
    "write_dair_v2x_index",
    "write_opv2v_frame",
    "write_v2v4real_frame",
]


def open_dataset(name: str, root: str | Path, split: str, options: Mapping[str, Any] | None = None) -> Dataset:
    """Open a split of a data set by name.

    Args:
        name: a name in `DATASETS`.
        root: folder of the data set.
        split: name of the split.
        options: further arguments of its class: `labels` of DAIR-V2X, `left_handed` of V2V4Real.

    Raises:
        ValueError: unknown data set, option or split; the message suggests the most similar one.
        FileNotFoundError: the data are missing; the message names the expected path.
    """
    if name not in DATASETS:
        raise ValueError(f"no data set {did_you_mean(name, DATASETS)}")
    known = [key for key in inspect.signature(DATASETS[name]).parameters if key not in ("root", "split")]
    for key in options or {}:
        if key not in known:
            raise ValueError(f"{name}: no option {did_you_mean(key, known)}")
    return DATASETS[name](root, split, **(options or {}))
