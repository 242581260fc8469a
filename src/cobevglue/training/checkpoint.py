"""Files of a training run: weights, state for resuming, and provenance."""

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
from cobevglue.datasets.atomic_files import atomic_write

__all__ = ["LAST", "STATE", "RunState", "begin_run", "differing_keys", "load_state", "provenance", "save_state"]

STATE, LAST = "state.pt", "last.safetensors"
"""Names of files in the folder of a run."""

_FORMAT = 1
_CPU = torch.device("cpu")


@dataclass(frozen=True)
class RunState:
    """State of a run at the end of an epoch.

    Attributes:
        config: settings of the run, JSON-serialisable.
        processes: number of processes.
        epoch: number of completed epochs.
        elapsed: training time so far [s].
        best: the best validation score so far; None before the first validation.
        model: weights.
        mean_model: running mean of the weights.
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
    """Write the state of a run atomically."""
    content = {**vars(state), "config": json.dumps(state.config), "format": _FORMAT}
    with atomic_write(path) as partial:
        torch.save(content, partial)


def load_state(path: Path, device: torch.device) -> RunState:
    """Read the state of a run. Code in the file is not executed.

    Args:
        path: of the file.
        device: of the tensors that are read.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: it is damaged or has another format version.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is not there: no epoch of this run was completed")
    try:
        content = torch.load(path, map_location=device, weights_only=True)
        found = content.pop("format")
        if found != _FORMAT:
            raise ValueError(f"its format is {found}, this version reads {_FORMAT}")
        return RunState(**{**content, "config": json.loads(content["config"])})
    except Exception as error:  # unpickling damaged bytes raises many types of errors
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
    """Check the folder of a run, and load the state to resume from.

    Args:
        folder: of the run.
        settings: of the run, JSON-serialisable.
        free_to_change: names of the top-level settings that may differ when a run is resumed.
        resume: resume the run in the folder.
        processes: number of processes that train together.
        device: of the tensors of the state.

    Returns:
        The state, or None for a new run.

    Raises:
        FileNotFoundError: no state to resume from.
        ValueError: a new run in a folder that contains one; other settings than those of the run to resume; a damaged
            file.
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
    """Dotted names of the settings that differ, sorted."""
    names: list[str] = []
    for key in sorted({*one, *other}):
        a, b = one.get(key), other.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            names += differing_keys(a, b, f"{prefix}{key}.")
        elif a != b:
            names.append(f"{prefix}{key}")
    return names


def provenance() -> dict[str, str]:
    """Provenance of weights: versions, git commit (if the package is run from a checkout), command."""
    return {
        "cobevglue": cobevglue.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "commit": _git_commit(),
        "command": shlex.join(sys.argv),
    }


def _git_commit() -> str:
    """Commit of the checkout, with "+" if tracked files were modified; "" outside a checkout."""
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
