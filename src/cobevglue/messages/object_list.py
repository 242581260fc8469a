"""The object list: boxes as a JSON document.

    {"boxes": [{"x": 12.5, "y": -3.0, "z": -1.1, "l": 4.5, "w": 1.9, "h": 1.5, "yaw": 0.1,
                "score": 0.9, "track_id": 7, "label": "car"}]}

Centres and sizes are in metres and yaw is in radians, in the frame of the observing agent (x forward, y left, z up, yaw
from x towards y). `x`, `y`, `l`, `w` and `yaw` are required; `z` and `h` default to 0; `score`, `track_id` and `label`
must be given in all rows or in none. A value of `null` is the same as a missing key. Unknown keys are errors, so that a
misspelt key is not silently ignored.
"""

from __future__ import annotations

import difflib
import json
import math
import reprlib
from pathlib import Path
from typing import Any

from cobevglue.boxes import Boxes

__all__ = ["from_dict", "read_object_list", "to_dict", "write_object_list"]

_REQUIRED = ("x", "y", "l", "w", "yaw")
_ZERO_WHEN_MISSING = ("z", "h")
_ALL_OR_NONE = ("score", "track_id", "label")
_KEYS = ("x", "y", "z", "l", "w", "h", "yaw", *_ALL_OR_NONE)
_SYNONYMS = {
    "length": "l",
    "width": "w",
    "height": "h",
    "heading": "yaw",
    "theta": "yaw",
    "id": "track_id",
    "confidence": "score",
    "class": "label",
    "type": "label",
}
"""Key names of other formats, mapped to the keys of the object list, for suggestions in error messages."""
_LARGEST_ID = 2**63 - 1


class _RepeatedKey(dict[str, Any]):
    """A JSON object with a repeated key; Python's parser would silently keep the last value."""

    key: str


def read_object_list(path: str | Path) -> Boxes:
    """Read the boxes of an object list file.

    Args:
        path: a JSON file, UTF-8.

    Returns:
        Boxes in the frame of the agent that wrote the file.

    Raises:
        ValueError: the content is invalid; the one-line message names the file, the row and the field.
        OSError: the file cannot be read; the message names it.
    """
    source = str(path)
    try:
        text = Path(path).read_text(encoding="utf-8-sig")  # accepts a byte order mark, which some editors write
        document = json.loads(text, object_pairs_hook=_object)
    except UnicodeDecodeError as error:
        raise ValueError(f"{source}: not JSON: not UTF-8 text (byte {error.start})") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"{source}: not JSON: {error.msg} (line {error.lineno}, column {error.colno})") from None
    except (ValueError, RecursionError) as error:  # a number with thousands of digits, or too deep nesting
        raise ValueError(f"{source}: unreadable JSON: {error}") from None
    return from_dict(document, source=source)


def write_object_list(path: str | Path, boxes: Boxes) -> None:
    """Write an object list file, one row per line; `read_object_list` restores exactly the same numbers.

    Raises:
        OSError: the file cannot be written.
    """
    rows = ",\n".join(f"  {json.dumps(row, ensure_ascii=False, allow_nan=False)}" for row in to_dict(boxes)["boxes"])
    text = '{"boxes": [\n' + rows + "\n]}\n" if rows else '{"boxes": []}\n'
    Path(path).write_text(text, encoding="utf-8")


def to_dict(boxes: Boxes) -> dict[str, list[dict[str, Any]]]:
    """Convert boxes to the document of an object list: plain Python values for `json.dumps`.

    Fields that `boxes` does not have are omitted, so an empty list does not record which fields were present.
    """
    columns: dict[str, list[Any]] = {
        "x": boxes.center[:, 0].tolist(),
        "y": boxes.center[:, 1].tolist(),
        "z": boxes.center[:, 2].tolist(),
        "l": boxes.size[:, 0].tolist(),
        "w": boxes.size[:, 1].tolist(),
        "h": boxes.size[:, 2].tolist(),
        "yaw": boxes.yaw.tolist(),
    }
    for key in _ALL_OR_NONE:
        values = getattr(boxes, key)
        if values is not None:
            columns[key] = values.tolist()
    return {"boxes": [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]}


def from_dict(document: Any, source: str = "object list") -> Boxes:
    """Convert the parsed document of an object list to boxes.

    Args:
        document: the document, as returned by `to_dict` or `json.loads`.
        source: name of the document in error messages, for example a file name.

    Returns:
        Boxes in the frame of the agent that made the list.

    Raises:
        ValueError: the content is invalid; the one-line message names `source`, the row and the field.
    """
    if not isinstance(document, dict):
        raise ValueError(f'{source}: must be a JSON object {{"boxes": [...]}}, got {_kind(document)}')
    _check_keys(document, ("boxes",), source)
    if "boxes" not in document:
        raise ValueError(f'{source}: the key "boxes" is missing')
    rows = document["boxes"]
    if not isinstance(rows, list):
        raise ValueError(f"{source}: boxes must be a list, got {_kind(rows)}")

    columns: dict[str, list[Any]] = {key: [] for key in _KEYS}
    for number, row in enumerate(rows):
        where = f"{source}: boxes: row {number}"
        if not isinstance(row, dict):
            raise ValueError(f"{where} must be an object with the keys {', '.join(_KEYS)}, got {_kind(row)}")
        _check_keys(row, _KEYS, where)
        for key in _KEYS:
            columns[key].append(_value(row, key, where))
    optional = {key: _all_or_none(columns[key], key, source) for key in _ALL_OR_NONE}
    try:
        return Boxes(
            center=list(zip(columns["x"], columns["y"], columns["z"], strict=True)),
            size=list(zip(columns["l"], columns["w"], columns["h"], strict=True)),
            yaw=columns["yaw"],
            **optional,
        )
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the parsed JSON object, or `_RepeatedKey` for `from_dict`, which can report the row."""
    whole = dict(pairs)
    if len(whole) == len(pairs):
        return whole
    marked = _RepeatedKey(whole)
    names = [name for name, _ in pairs]
    marked.key = next(name for i, name in enumerate(names) if name in names[:i])
    return marked


def _check_keys(mapping: dict[Any, Any], valid: tuple[str, ...], where: str) -> None:
    """Reject repeated and unknown keys; the error names the nearest valid key."""
    if isinstance(mapping, _RepeatedKey):
        raise ValueError(f"{where}: the key {_shown(mapping.key)} comes twice")
    for key in mapping:
        if key not in valid:
            nearest = _nearest(str(key).lower(), valid)
            all_valid = f"; valid keys: {', '.join(valid)}" if len(valid) > 1 else ""
            raise ValueError(f'{where}: unknown key {_shown(key)}, the nearest valid key is "{nearest}"{all_valid}')


def _nearest(key: str, valid: tuple[str, ...]) -> str:
    synonym = _SYNONYMS.get(key)
    if synonym in valid:
        return str(synonym)
    return (difflib.get_close_matches(key, valid, n=1, cutoff=0.0) or [valid[0]])[0]


def _value(row: dict[str, Any], key: str, where: str) -> Any:
    """Return the checked value of `key`: a float, an int (track_id), a string (label), or None if missing."""
    value = row.get(key)
    if value is None:
        if key in _REQUIRED:
            raise ValueError(f'{where}: the key "{key}" is missing')
        return 0.0 if key in _ZERO_WHEN_MISSING else None
    if key == "label":
        if not isinstance(value, str):
            raise ValueError(f"{where}: label must be a string, got {_shown(value)}")
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{where}: {key} must be a number, got {_shown(value)}")
    if key == "track_id":
        if value != value or abs(value) > _LARGEST_ID or value != int(value):
            raise ValueError(f"{where}: track_id must be a whole number below 2^63, got {_shown(value)}")
        return int(value)
    try:
        number = float(value)
    except OverflowError:  # an integer with hundreds of digits
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{where}: {key} must be a finite number, got {_shown(value)}")
    return number


def _all_or_none(values: list[Any], key: str, source: str) -> list[Any] | None:
    """Return the column, or None if no row has it; ValueError if only some rows have it."""
    absent = [value is None for value in values]
    if all(absent):
        return None
    if any(absent):
        missing, given = absent.index(True), absent.index(False)
        raise ValueError(
            f"{source}: boxes: row {missing}: {key} is missing, but row {given} has it: give it in all rows or in none"
        )
    return values


def _kind(value: Any) -> str:
    """Return the JSON name of a value's type."""
    kinds = {dict: "an object", list: "a list", str: "a string", bool: "a boolean", type(None): "null"}
    return next((name for kind, name in kinds.items() if isinstance(value, kind)), f"a {type(value).__name__}")


def _shown(value: Any) -> str:
    """Return the value as text for a one-line message, shortened if it is long."""
    return reprlib.repr(value)
