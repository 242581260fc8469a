"""CoBEVGlue: connected vehicles and roadside units see together without trusting GPS."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cobevglue.alignment import Alignment, BEVGlue, BEVGlueConfig
    from cobevglue.boxes import Boxes
    from cobevglue.se2 import SE2
    from cobevglue.system import CoBEVGlue

__version__ = "0.1.0"
__all__ = ["SE2", "Alignment", "BEVGlue", "BEVGlueConfig", "Boxes", "CoBEVGlue", "__version__"]

_HOME = {
    "SE2": "cobevglue.se2",
    "Alignment": "cobevglue.alignment",
    "BEVGlue": "cobevglue.alignment",
    "BEVGlueConfig": "cobevglue.alignment",
    "Boxes": "cobevglue.boxes",
    "CoBEVGlue": "cobevglue.system",
}


def __getattr__(name: str) -> Any:
    """Import public names when they are first used: `cobevglue --help` should not wait for NumPy and pydantic."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
