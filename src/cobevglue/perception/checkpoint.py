"""Checkpoints: one safetensors file with the weights, and settings and training metadata in its header.

The file holds numbers and text but no code, so loading untrusted files is safe.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from cobevglue.datasets.atomic_files import atomic_write
from cobevglue.relative_paths import without_absolute_paths

__all__ = ["Checkpoint", "fingerprint", "load_checkpoint", "load_weights", "save_checkpoint"]

_FORMAT = "1"
"""Incremented when files of the previous version can no longer be read."""
_MAGIC = "cobevglue_format"


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """Contents of a file: settings as plain data, float32 weights by name, and metadata."""

    config: dict[str, Any]
    weights: dict[str, Tensor]
    metadata: dict[str, Any]


def save_checkpoint(
    path: str | Path,
    architecture: str,
    config: Mapping[str, Any],
    module: nn.Module,
    metadata: Mapping[str, Any] | None = None,
    half: bool = False,
) -> None:
    """Write the weights of `module` atomically.

    Args:
        path: of the file.
        architecture: name of the network architecture, checked when loading.
        config: its settings, JSON-serialisable.
        module: the network.
        metadata: data, metrics, seed and the like, JSON-serialisable. Absolute paths in it are made relative.
        half: store weights as float16, for half the size; statistics of the normalisation stay float32.
    """
    weights = {}
    for name, value in module.state_dict().items():
        narrow = half and value.is_floating_point() and "running_" not in name
        weights[name] = value.detach().to("cpu", torch.float16 if narrow else value.dtype).contiguous()
    header = {
        _MAGIC: _FORMAT,
        "architecture": architecture,
        "config": json.dumps(config),
        "metadata": json.dumps(without_absolute_paths(dict(metadata or {}))),
    }
    with atomic_write(Path(path)) as partial:
        save_file(weights, partial, header)


def load_checkpoint(path: str | Path, architecture: str) -> Checkpoint:
    """Read a file that `save_checkpoint` wrote.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: it is damaged, not a checkpoint of CoBEVGlue, or of another format version or architecture.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with safe_open(str(path), framework="pt") as file:
            header = file.metadata() or {}
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{path}: damaged, or no safetensors file: {error}") from None
    if _MAGIC not in header:
        raise ValueError(f"{path}: a safetensors file, but not one of CoBEVGlue's: its header has no {_MAGIC!r}")
    if header[_MAGIC] != _FORMAT:
        raise ValueError(f"{path}: format {header[_MAGIC]}; this version of cobevglue reads format {_FORMAT}")
    if header.get("architecture") != architecture:
        raise ValueError(f"{path}: weights of {header.get('architecture')!r}, not of {architecture!r}")
    try:
        config, metadata = json.loads(header["config"]), json.loads(header["metadata"])
    except (KeyError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: damaged header: {error!r}") from None
    floats = {name: value.float() if value.is_floating_point() else value for name, value in weights.items()}
    return Checkpoint(config, floats, metadata)


def load_weights(module: nn.Module, weights: Mapping[str, Tensor], path: str | Path) -> None:
    """Load weights into a network.

    Raises:
        ValueError: a weight is missing, unexpected, of wrong shape or not finite; the message names the first one.
    """
    own = module.state_dict()
    for name in sorted(own.keys() | weights.keys()):
        if name not in weights:
            raise ValueError(f"{path}: weight {name!r} is missing")
        if name not in own:
            raise ValueError(f"{path}: weight {name!r} is not part of this network")
        if own[name].shape != weights[name].shape:
            shapes = f"{tuple(weights[name].shape)}, this network's {tuple(own[name].shape)}"
            raise ValueError(f"{path}: weight {name!r} has shape {shapes}")
        if not torch.isfinite(weights[name]).all():
            raise ValueError(f"{path}: weight {name!r} is not finite")
    module.load_state_dict(dict(weights))


def fingerprint(module: nn.Module) -> str:
    """Hash of the weights of a network, 16 hexadecimal digits."""
    digest = hashlib.sha256()
    for name, value in sorted(module.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]
