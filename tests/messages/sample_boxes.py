"""Boxes to put into messages."""

from __future__ import annotations

from typing import Any

import numpy as np

from cobevglue import Boxes


def boxes(n: int = 2, **changes: Any) -> Boxes:
    """N tracked boxes; `changes` replace columns."""
    columns: dict[str, Any] = {
        "center": np.arange(3 * n, dtype=float).reshape(n, 3) + 0.25,
        "size": np.tile([4.5, 2.0, 1.5], (n, 1)),
        "yaw": np.linspace(-3, 3, n),
        "track_id": np.arange(n) + 7,
    }
    return Boxes(**{**columns, **changes})
