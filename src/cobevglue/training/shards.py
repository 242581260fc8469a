"""Precomputed training data on disk, in shards: the computation can be interrupted and distributed over processes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from cobevglue.datasets.atomic_files import write_json

__all__ = ["read_index", "write_shards"]

_INDEX, _SETTINGS = "index.json", "settings.json"


def write_shards(
    folder: Path,
    settings: Mapping[str, Any],
    count: int,
    write: Callable[[int], list[str]],
    processes: int,
    progress: Callable[[int, int], None],
) -> None:
    """Compute the shards that are missing in a folder.

    Args:
        folder: created if missing.
        settings: all settings that the content depends on, JSON-serialisable; stored in `index.json`.
        count: number of shards.
        write: writes one shard, given its index, and returns the names of its files in `folder`; picklable.
        processes: number of processes; if several, each uses one thread.
        progress: is called after each shard with the number of completed shards and of their files.

    Raises:
        ValueError: the folder was written with other settings.
    """
    folder.mkdir(parents=True, exist_ok=True)
    started = folder / _SETTINGS
    if not started.is_file():
        write_json(started, settings)
    elif json.loads(started.read_text(encoding="utf-8")) != settings:
        raise ValueError(f"{folder}: was made with other settings or another detector; choose another folder")
    if (folder / _INDEX).is_file():
        return
    files: list[str] = []
    with _map(processes) as mapped:
        for number, names in enumerate(mapped(partial(_write_missing, folder, write), range(count)), start=1):
            files += names
            progress(number, len(files))
    write_json(folder / _INDEX, {**settings, "files": files})


def read_index(folder: Path) -> dict[str, Any]:
    """The settings of a completed folder, and the names of its files under the key "files".

    Raises:
        FileNotFoundError: the folder is missing or incomplete.
    """
    index = folder / _INDEX
    if not index.is_file():
        raise FileNotFoundError(f"{folder}: not finished: {index.name} is not there")
    content: dict[str, Any] = json.loads(index.read_text(encoding="utf-8"))
    return content


@contextmanager
def _map(processes: int) -> Iterator[Callable[[Callable[[int], list[str]], range], Iterable[list[str]]]]:
    """`map` in this process or in several."""
    if processes == 1:
        yield map
    else:
        fresh = get_context("spawn")  # forking while torch has threads can deadlock
        with ProcessPoolExecutor(processes, fresh, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            yield pool.map


def _write_missing(folder: Path, write: Callable[[int], list[str]], number: int) -> list[str]:
    done = folder / f"{number:04d}.json"
    if not done.is_file():
        write_json(done, write(number))
    names: list[str] = json.loads(done.read_text(encoding="utf-8"))
    return names
