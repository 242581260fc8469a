"""Text without the absolute paths of one machine, for files that others read: weights, reports."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

__all__ = ["without_absolute_paths"]

_ABSOLUTE = re.compile(r"(?<![\w.:/~-])/(?:[^\s/'\",<>]+/)*[^\s/'\",<>]+/?")
_MODULE = re.compile(r"/cobevglue/(?:cli/)?__main__\.py$")


def without_absolute_paths(value: Any) -> Any:
    """Plain data (as JSON can hold it) with every absolute path in its strings made relative.

    A path in the working directory becomes relative to it; of any other, the last part stays. The file that
    `python -m cobevglue` runs becomes `cobevglue`. Web addresses stay, and so do the keys of mappings.
    """
    if isinstance(value, str):
        return _ABSOLUTE.sub(lambda match: _relative(match[0]), value)
    if isinstance(value, dict):
        return {key: without_absolute_paths(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_absolute_paths(item) for item in value]
    return value


def _relative(path: str) -> str:
    if _MODULE.search(path):
        return "cobevglue"
    here = Path.cwd()
    return Path(path).relative_to(here).as_posix() if Path(path).is_relative_to(here) else Path(path).name
