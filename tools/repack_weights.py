"""Rewrite the header of weights files and, optionally, the names of their tensors. The weights are unchanged.

    python tools/repack_weights.py src/cobevglue/*/weights/*.safetensors

makes absolute paths in the metadata relative. For other changes, call `repack` with other functions.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import save_file

from cobevglue.datasets.atomic_files import atomic_write
from cobevglue.relative_paths import without_absolute_paths


def repack(
    path: Path,
    metadata: Callable[[Any], Any] = without_absolute_paths,
    name: Callable[[str], str] = lambda old: old,
) -> None:
    """Rewrite a file.

    Args:
        path: the file, which is replaced.
        metadata: maps the old metadata to the new metadata, plain data.
        name: maps the old name of a tensor to the new name.
    """
    with safe_open(str(path), framework="pt") as file:
        header = dict(file.metadata() or {})
        tensors = {name(old): file.get_tensor(old) for old in file.keys()}  # noqa: SIM118
        count = len(list(file.keys()))
    if len(tensors) != count:
        raise ValueError(f"{path}: two tensors would have the same name")
    header["metadata"] = json.dumps(metadata(json.loads(header["metadata"])))
    with atomic_write(path) as partial:
        save_file(tensors, partial, header)


def main() -> None:
    """Repack the files given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+")
    for path in parser.parse_args().files:
        repack(path)
        print(path)


if __name__ == "__main__":
    main()
