"""LiDAR clouds in PCD files (ASCII, binary and binary_compressed) and KITTI's binary files."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cobevglue.datasets.atomic_files import atomic_write
from cobevglue.typing import ArrayLike, Float32Array

__all__ = ["read_bin", "read_pcd", "write_pcd_intensity", "write_pcd_rgb"]


def read_pcd(path: str | Path, left_handed: bool = False, intensity_scale: float = 1.0) -> Float32Array:
    """Read the points of a PCD file; those with non-finite coordinates (no return) are omitted.

    OPV2V was written with Open3D, which does not support intensity: it is the red byte of the packed colour `rgb`, a
    32-bit integer stored with the type float. In ASCII files these are numbers like 1.5e-38.

    Args:
        path: the file, with fields x, y, z and either `intensity` or `rgb`; with neither, the intensity is 0. NaN
            intensities become 0.
        left_handed: the y axis of the file points to the right; it is mirrored.
        intensity_scale: factor from the field `intensity` to [0, 1]. Not applied to `rgb`, which is 8 bit.

    Returns:
        (N, 4) x, y, z [m], intensity in [0, 1]; x forward, y left, z up.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: it is not valid PCD, or is shorter than its header states; the message names the file.
    """
    data = _columns(Path(path))
    names = data.dtype.names or ()
    missing = [name for name in ("x", "y", "z") if name not in names]
    if missing:
        raise ValueError(f"{path}: no field {missing[0]!r} among the fields {', '.join(names)}")
    points = np.zeros((len(data), 4), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # doubles beyond the range of float32 are omitted below
        for column, name in enumerate(("x", "y", "z")):
            points[:, column] = data[name]
    if left_handed:
        points[:, 1] *= -1.0
    if "intensity" in names:
        with np.errstate(invalid="ignore"):
            points[:, 3] = np.clip(data["intensity"].astype(np.float64) * intensity_scale, 0.0, 1.0)
    elif "rgb" in names:
        if data.dtype["rgb"].itemsize != 4:
            raise ValueError(f"{path}: the field 'rgb' must have 4 bytes, got {data.dtype['rgb'].itemsize}")
        packed = np.ascontiguousarray(data["rgb"]).view(np.uint32)
        points[:, 3] = ((packed >> 16) & 0xFF) / 255.0
    return _finite(points)


def read_bin(path: Path) -> Float32Array:
    """Read the points of a file in KITTI's format: x, y, z [m] and intensity of each point as little-endian float32.

    The intensities of KITTI and of DAIR-V2X's converter are in [0, 1]. If the maximum of a file is above 1, they are
    raw values from 0 to 255 and divided by 255.

    Args:
        path: the file.

    Returns:
        (N, 4) x, y, z [m], intensity in [0, 1], without points with non-finite coordinates.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: it is empty, or its size is not a multiple of 16 bytes; the message names the file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist")
    size = path.stat().st_size
    if size == 0:
        raise ValueError(f"{path}: is empty (0 bytes)")
    if size % 16:
        raise ValueError(f"{path}: {size} bytes are not a multiple of 16 (points of 4 float32)")
    points = np.fromfile(path, dtype="<f4").reshape(-1, 4).astype(np.float32)
    points = _finite(points)
    if (points[:, 3] > 1.0).any():
        points[:, 3] /= 255.0
    points[:, 3] = np.clip(points[:, 3], 0.0, 1.0)
    return points


def _finite(points: Float32Array) -> Float32Array:
    """The points with finite coordinates; non-finite intensities become 0."""
    points[~np.isfinite(points[:, 3]), 3] = 0.0
    return points[np.isfinite(points[:, :3]).all(axis=1)]


def write_pcd_rgb(path: Path, points: ArrayLike, left_handed: bool = True) -> None:
    """Write a cloud in OPV2V's format: binary PCD, the intensity in the red byte of `rgb`.

    Args:
        path: the file, replaced atomically if it exists.
        points: (N, 4) x, y, z [m], y to the left, and intensity in [0, 1], of which 8 bits are kept.
        left_handed: write the y axis to the right, as in OPV2V.

    Raises:
        ValueError: the points have another shape, are not finite, or an intensity is not in [0, 1].
    """
    cloud, level = _checked_cloud(points)
    red = level.astype(np.uint32) << 16
    side = -cloud[:, 1] if left_handed else cloud[:, 1]
    _write(path, ("x", "y", "z", "rgb"), [cloud[:, 0], side, cloud[:, 2], red.view(np.float32)])


def write_pcd_intensity(path: Path, points: ArrayLike) -> None:
    """Write a cloud in the format of real sensors: binary PCD, y to the left, `intensity` from 0 to 255.

    Args:
        path: the file, replaced atomically if it exists.
        points: (N, 4) x, y, z [m] and intensity in [0, 1], of which 8 bits are kept.

    Raises:
        ValueError: the points have another shape, are not finite, or an intensity is not in [0, 1].
    """
    cloud, level = _checked_cloud(points)
    _write(path, ("x", "y", "z", "intensity"), [*cloud[:, :3].T, level])


def _checked_cloud(points: ArrayLike) -> tuple[Float32Array, Float32Array]:
    """Validate a cloud; returns it and its (N,) intensities as integers from 0 to 255."""
    cloud = np.asarray(points, dtype=np.float32)
    if cloud.ndim != 2 or cloud.shape[1] != 4:
        raise ValueError(f"points must have shape (N, 4), got {cloud.shape}")
    if not np.isfinite(cloud).all() or (cloud[:, 3] < 0).any() or (cloud[:, 3] > 1).any():
        raise ValueError("points must be finite with intensities in [0, 1]")
    return cloud, np.rint(cloud[:, 3] * np.float32(255.0))


def _write(path: Path, fields: Sequence[str], columns: Sequence[Float32Array]) -> None:
    from pypcd4.pypcd4 import Encoding, PointCloud  # imported here: it takes longer than the rest of the package

    cloud = PointCloud.from_points(list(columns), fields, (np.float32,) * len(fields))
    with atomic_write(path) as partial:
        cloud.save(partial, encoding=Encoding.BINARY)


def _columns(path: Path) -> np.ndarray[tuple[int], np.dtype[Any]]:
    """The points of a file as a structured array with a column for each field."""
    from pydantic import ValidationError
    from pypcd4.pypcd4 import PointCloud

    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of empty tables; the count is checked below
            cloud = PointCloud.from_fileobj(io.BufferedReader(io.BytesIO(_with_counts(path.read_bytes()))))
        # (a table of one row loses its axis in numpy's text reader)
        data: np.ndarray[tuple[int], np.dtype[Any]] = np.atleast_1d(cloud.pc_data)
        expected = int(cloud.metadata.points)
    except ValidationError as error:  # of the header
        absent = [str(problem["loc"][0]).upper() for problem in error.errors() if problem["type"] == "missing"]
        first = error.errors()[0]
        why = f"the header has no {', '.join(absent)}" if absent else f"{first['loc'][0]}: {first['msg']}"
        raise ValueError(f"{path}: not readable as PCD: {why}") from None
    except Exception as error:  # malformed bytes raise struct, lzf, numpy and lookup errors in the parser
        raise ValueError(f"{path}: not readable as PCD: {' '.join(str(error).split())[:200]}") from None
    if len(data) != expected:
        raise ValueError(f"{path}: the header states {expected} points, the file has {len(data)}")
    return data


def _with_counts(content: bytes) -> bytes:
    """The file with a COUNT of at least 1 for every field, as `pypcd4` requires.

    COUNT may be missing (it defaults to 1). Fields of COUNT 0, which some sensor vendors export, hold no data.
    """
    data = re.search(rb"(?m)^DATA\b", content)
    if data is None:
        return content  # the parser reports what is missing
    start = data.start()
    lines = content[:start].split(b"\n")
    header = {words[0]: words[1:] for line in lines if (words := line.split())}
    fields = header.get(b"FIELDS", [])
    counts = header.get(b"COUNT")
    if counts is not None and b"0" not in counts:
        return content
    if counts is not None and len(counts) != len(fields):
        return content
    kept = [row for row in range(len(fields)) if counts is None or counts[row] != b"0"]
    try:
        table = {name: [header[name][row] for row in kept] for name in (b"FIELDS", b"SIZE", b"TYPE")}
    except (KeyError, IndexError):
        return content  # the parser reports what is missing
    table[b"COUNT"] = [b"1" if counts is None else counts[row] for row in kept]
    rows = [b" ".join([name, *values]) for name, values in table.items()]
    rest = [line for line in lines if line.split() and line.split()[0] not in table]
    return b"\n".join([*rows, *rest, content[start:]])
