"""Files of a run: the weights, and all that is needed to go on where it was left."""

from __future__ import annotations

import json
import platform
import shlex
import subprocess
import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

import cobevglue
from cobevglue.datasets.whole_files import whole_file

__all__ = ["LAST", "STATE", "RunState", "begin_run", "differing_keys", "load_state", "provenance", "save_state"]

STATE, LAST = "state.pt", "last.safetensors"
"""Files in the folder of every run."""

_FORMAT = 1
_CPU = torch.device("cpu")


@dataclass(frozen=True)
class RunState:
    """A run at the end of an epoch.

    Attributes:
        config: settings of the run, as plain data.
        processes: how many processes it ran in.
        epoch: epochs done.
        elapsed: time spent so far [s].
        best: the best validation score so far; None before the first validation.
        model: weights.
        mean_model: their running mean.
        optimizer: state of the optimiser.
    """

    config: dict[str, Any]
    processes: int
    epoch: int
    elapsed: float
    best: float | None
    model: dict[str, torch.Tensor]
    mean_model: dict[str, torch.Tensor]
    optimizer: dict[str, Any]


def save_state(path: Path, state: RunState) -> None:
    """Write a run's state; the file is either complete or the one before."""
    content = {**vars(state), "config": json.dumps(state.config), "format": _FORMAT}
    with whole_file(path) as partial:
        torch.save(content, partial)


def load_state(path: Path, device: torch.device) -> RunState:
    """Read a run's state. Nothing in the file can run code.

    Raises:
        FileNotFoundError: there is none.
        ValueError: the file is broken or of another version; names it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is not there: no epoch of this run was completed")
    try:
        content = torch.load(path, map_location=device, weights_only=True)
        found = content.pop("format")
        if found != _FORMAT:
            raise ValueError(f"its format is {found}, this version reads {_FORMAT}")
        return RunState(**{**content, "config": json.loads(content["config"])})
    except Exception as error:  # whatever unpickling broken bytes raises
        raise ValueError(f"{path}: not the state of a run: {' '.join(str(error).split())[:200]}") from error


def begin_run(
    folder: Path,
    settings: Mapping[str, Any],
    free_to_change: Collection[str],
    *,
    resume: bool,
    processes: int = 1,
    device: torch.device = _CPU,
) -> RunState | None:
    """What a run starts from: the state in its folder, or None for nothing.

    Args:
        folder: of the run.
        settings: of the run, as plain data.
        free_to_change: names of settings with which a run may go on differently.
        resume: go on with the run in the folder.
        processes: how many train together.
        device: where the state is read to.

    Raises:
        FileNotFoundError: there is nothing to resume.
        ValueError: there is a run already, or one with other settings, or its file is broken.
    """
    file = folder / STATE
    if not resume:
        if file.exists():
            raise ValueError(f"{folder}: has a run already; resume it, or choose another folder")
        return None
    state = load_state(file, device)
    differing = [key for key in differing_keys(state.config, settings) if key.partition(".")[0] not in free_to_change]
    if state.processes != processes:
        differing.append(f"number of processes ({state.processes} before, now {processes})")
    if differing:
        raise ValueError(f"{folder}: the run was started with other settings: {', '.join(differing)}")
    return state


def differing_keys(one: Mapping[str, Any], other: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Dotted names of the settings that are not the same in both, sorted."""
    names: list[str] = []
    for key in sorted({*one, *other}):
        a, b = one.get(key), other.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            names += differing_keys(a, b, f"{prefix}{key}.")
        elif a != b:
            names.append(f"{prefix}{key}")
    return names


def provenance() -> dict[str, str]:
    """Where weights come from: versions, git commit (where the package is run from a checkout), command."""
    return {
        "cobevglue": cobevglue.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "commit": _git_commit(),
        "command": shlex.join(sys.argv),
    }


def _git_commit() -> str:
    """The checkout's commit, with "+" where tracked files were changed since; "" outside a checkout."""
    folder = Path(cobevglue.__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return ""
    answer = []
    for words in (["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no"]):
        try:
            done = subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, timeout=10, check=True)
        except (OSError, subprocess.SubprocessError):
            return ""
        answer.append(done.stdout.strip())
    return answer[0] + ("+" if answer[1] else "")
