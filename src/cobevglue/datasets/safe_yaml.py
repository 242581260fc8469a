"""Safe reader of YAML files with numpy arrays and scalars: no code of a file is executed.

V2V4Real (and files written by scripts that dump numpy values) tag arrays as PyYAML's full dumper does, as calls to
numpy's pickle helpers. They are usually read with an unsafe loader, which would run any call named in the file. Here
only these helpers are decoded, with numeric types only; every other tag is an error.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Hashable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cobevglue.typing import ArrayLike

__all__ = ["read_yaml"]

try:
    from yaml import CSafeLoader as _SafeLoader
except ImportError:  # PyYAML built without libyaml: slower, same result
    from yaml import SafeLoader as _SafeLoader  # type: ignore[assignment]

_TOP_LEVEL_KEY = re.compile(r"(?m)^(?=[A-Za-z_]\w*:)")


def read_yaml(path: Path, keys: Collection[str]) -> dict[str, Any]:
    """Read the top-level mapping of a YAML file.

    Args:
        path: the file.
        keys: the top-level keys to read; others may be skipped without parsing, which saves time on files with much
            other content (cameras, planned trajectories).

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: it is not YAML, not a mapping, repeats a key, or has a tag that is not plain data; the message
            names the file.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # a byte-order mark is not part of the first key
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} does not exist") from None
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file: {error}") from None
    # An alias may refer to an anchor in another block, so files with aliases are parsed completely.
    if not re.search(r"(?m)(?:[:-] |^)[&*]\w", text):
        blocks = _TOP_LEVEL_KEY.split(text)
        text = "".join(block for block in blocks if block.partition(":")[0] in keys) or text
    try:
        document = yaml.load(text, Loader=_NumpySafeLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not readable as YAML: {' '.join(str(error).split())}") from None
    if not isinstance(document, dict):
        raise ValueError(f"{path}: must be a mapping with {', '.join(keys)}, got {type(document).__name__}")
    return document


class _NumpySafeLoader(_SafeLoader):
    """Safe loader with tuples and numeric numpy arrays, scalars and types; repeated keys are an error."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        pairs = node.value
        mapping: dict[Hashable, Any] = super().construct_mapping(node, deep)
        # PyYAML keeps the last of equal keys: an object would be lost. (A merge, <<, makes a new list of pairs.)
        if node.value is pairs and len(mapping) != len(pairs):
            names = [key.value for key, _ in pairs]
            key = next((key for row, (key, _) in enumerate(pairs) if key.value in names[:row]), pairs[-1][0])
            raise yaml.constructor.ConstructorError(None, None, f"the key {key.value} is repeated", key.start_mark)
        return mapping


class _NdarrayName:
    """Placeholder of the name `numpy.ndarray` in a file."""


def _parts(loader: Any, node: yaml.Node) -> tuple[list[Any], Any]:
    """Arguments and state of a tagged call, written as a mapping or as a sequence of arguments."""
    if isinstance(node, yaml.MappingNode):
        call: dict[Hashable, Any] = loader.construct_mapping(node, deep=True)
        if not set(call) <= {"args", "state"}:
            raise _bad(node, "has more than args and state")
        return call.get("args", []), call.get("state")
    return loader.construct_sequence(node, deep=True), None


def _bad(node: yaml.Node, why: str) -> yaml.constructor.ConstructorError:
    return yaml.constructor.ConstructorError(None, None, f"a numpy value here {why}", node.start_mark)


def _dtype(loader: Any, node: yaml.Node) -> np.dtype[Any]:
    args, state = _parts(loader, node)
    name = args[0] if args else None
    if not isinstance(name, str) or re.fullmatch(r"[fiu][248]|[iub]1", name) is None:
        raise _bad(node, f"has the type {name!r}, which is not a plain number")
    order = state[1] if isinstance(state, tuple | list) and len(state) > 1 else "="
    if order not in ("<", ">", "=", "|"):
        raise _bad(node, f"has the byte order {order!r}")
    return np.dtype(name if order == "|" else order + name)


def _array(loader: Any, node: yaml.Node) -> ArrayLike:
    args, state = _parts(loader, node)
    if not args or not isinstance(args[0], _NdarrayName) or not isinstance(state, tuple | list) or len(state) != 5:
        raise _bad(node, "is not an array as PyYAML writes it")
    _, shape, dtype, column_major, data = state
    if not isinstance(dtype, np.dtype) or not isinstance(data, bytes):
        raise _bad(node, "is not an array of numbers")
    try:
        return np.frombuffer(data, dtype=dtype).reshape(shape, order="F" if column_major else "C").astype(np.float64)
    except (TypeError, ValueError) as error:
        raise _bad(node, f"does not have the size it claims: {error}") from None


def _scalar(loader: Any, node: yaml.Node) -> float:
    args, _ = _parts(loader, node)
    if len(args) != 2 or not isinstance(args[0], np.dtype) or not isinstance(args[1], bytes):
        raise _bad(node, "is not a number as PyYAML writes it")
    if len(args[1]) != args[0].itemsize:
        raise _bad(node, "does not have the size it claims")
    return float(np.frombuffer(args[1], dtype=args[0])[0])


def _tuple(loader: Any, node: yaml.Node) -> tuple[Any, ...]:
    return tuple(loader.construct_sequence(node, deep=True))


_PYTHON = "tag:yaml.org,2002:python/"
_NumpySafeLoader.add_constructor(f"{_PYTHON}tuple", _tuple)
_NumpySafeLoader.add_constructor(f"{_PYTHON}name:numpy.ndarray", lambda loader, node: _NdarrayName())
_NumpySafeLoader.add_constructor(f"{_PYTHON}object/apply:numpy.dtype", _dtype)
for _module in ("numpy.core.multiarray", "numpy._core.multiarray"):  # numpy 1 and 2
    _NumpySafeLoader.add_constructor(f"{_PYTHON}object/apply:{_module}._reconstruct", _array)
    _NumpySafeLoader.add_constructor(f"{_PYTHON}object/apply:{_module}.scalar", _scalar)
