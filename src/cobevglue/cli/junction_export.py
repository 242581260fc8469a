"""A simulated junction as a scenario in OPV2V's format, which can be interrupted and gone on with."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import cobevglue
from cobevglue.datasets import write_opv2v_frame
from cobevglue.se2 import SE2
from cobevglue.simulation import Junction, JunctionSettings, ObjectListFrame
from cobevglue.simulation.scripted_traffic import LIDAR_HEIGHT
from cobevglue.typing import FloatArray

__all__ = ["write_junction"]

_SETTINGS_FILE = "simulation.json"
_RATE = 10.0  # frames a second
_NUMBER_STEP = 2  # OPV2V counts simulation steps of 0.05 s
_SPEED_STEP = 0.01  # over which speeds are measured [s]
_NOTE_EVERY = 20  # frames


def write_junction(
    root: Path, split: str, *, seed: int, frames: int, agents: int, progress: Callable[[str], None]
) -> dict[str, Any]:
    """Write `<root>/<split>/junction_<seed>/<agent>/<number>.yaml`; what is there already is kept.

    Agents are named by their object ids, as OPV2V does it. Each file appears complete or not at all.

    Args:
        root: of the data set.
        split: name of its folder.
        seed: of the scene.
        frames: how many, 10 a second.
        agents: how many.
        progress: called with a line now and then.

    Returns:
        Where it is and how many files were written and kept, ready for JSON.

    Raises:
        ValueError: the split is no plain name, or the scenario's folder holds a scene with other settings.
        OSError: a file cannot be written.
    """
    if split in ("", ".", "..") or Path(split).name != split:
        raise ValueError(f"the split must be a plain folder name, got {split!r}")
    scenario = root / split / f"junction_{seed:04d}"
    scene = Junction(seed, JunctionSettings(agents=agents, duration=frames / _RATE, rate=_RATE))
    settings = {"simulation": "junction", "seed": seed, "frames": frames, "agents": agents}
    _claim(scenario, {**settings, "cobevglue": cobevglue.__version__})
    written = 0
    for index in range(frames):
        number = f"{_NUMBER_STEP * index:06d}"
        missing = [i for i in range(agents) if not (scenario / str(i) / f"{number}.yaml").exists()]
        if missing:
            frame, speeds = scene[index], _speeds(scene, index)
            for agent in missing:
                _write_view(scenario, number, frame, agent, speeds)
            written += len(missing)
        if (index + 1) % _NOTE_EVERY == 0:
            progress(f"{index + 1} of {frames} frames")
    return {
        "root": str(root),
        "split": split,
        "scenario": scenario.name,
        "scenario_folder": str(scenario),
        "agents": [str(i) for i in range(agents)],
        "frames": frames,
        "files_written": written,
        "files_kept": frames * agents - written,
    }


def _claim(scenario: Path, settings: dict[str, Any]) -> None:
    """Make the scenario's folder, with the settings in it; an error if it is there with others."""
    path = scenario / _SETTINGS_FILE
    text = json.dumps(settings) + "\n"
    if path.exists():
        if path.read_text(encoding="utf-8") != text:
            raise ValueError(f"{path}: another scene is there already; take another folder, split or seed")
        return
    if scenario.exists() and any(scenario.iterdir()):
        raise ValueError(f"{scenario}: is there already and has no {_SETTINGS_FILE}: not made by this command")
    scenario.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _write_view(scenario: Path, number: str, frame: ObjectListFrame, agent: int, speeds: dict[int, float]) -> None:
    """Write what one agent saw at one time; to a folder beside it first, so that no file is ever half there."""
    view = frame.agents[f"car{agent + 1}"]
    folder = scenario / str(agent)
    folder.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".partial-", dir=scenario) as partial:
        write_opv2v_frame(
            partial,
            number,
            _world_SE3(view.world_SE2_agent, LIDAR_HEIGHT),
            view.visible,
            speeds=speeds,
            ego_speed=speeds[agent],
            world_SE3_vehicle=_world_SE3(view.world_SE2_agent, 0.0),
        )
        (Path(partial) / f"{number}.yaml").replace(folder / f"{number}.yaml")


def _world_SE3(world_SE2: SE2, height: float) -> FloatArray:
    """(4, 4) pose at this height above the ground [m]; the ground is at z = 0."""
    c, s = math.cos(world_SE2.yaw), math.sin(world_SE2.yaw)
    rows = [[c, -s, 0.0, world_SE2.x], [s, c, 0.0, world_SE2.y], [0.0, 0.0, 1.0, height], [0.0, 0.0, 0.0, 1.0]]
    return np.array(rows)


def _speeds(scene: Junction, index: int) -> dict[int, float]:
    """Speed of every vehicle by its object id [km/h]."""
    now = index / _RATE
    before, after = scene.traffic.at(now - _SPEED_STEP / 2), scene.traffic.at(now + _SPEED_STEP / 2)
    travelled = np.linalg.norm(after.center[:, :2] - before.center[:, :2], axis=1)
    return dict(enumerate((3.6 * travelled / _SPEED_STEP).tolist()))
