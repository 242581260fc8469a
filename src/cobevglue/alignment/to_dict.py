"""An alignment as a JSON document."""

from __future__ import annotations

import math
from typing import Any

from cobevglue.alignment.alignment import Alignment

__all__ = ["alignment_to_dict"]


def alignment_to_dict(alignment: Alignment) -> dict[str, Any]:
    """JSON document of an alignment: metres, radians and seconds; degrees where the key ends in `_deg`.

    Numbers that the aligner does not estimate are None.
    """
    pose = alignment.ego_SE2_other
    return {
        "accepted": bool(alignment.accepted),
        "reason": alignment.reason,
        "ego_SE2_other": None
        if pose is None
        else {"x": pose.x, "y": pose.y, "yaw": pose.yaw, "yaw_deg": math.degrees(pose.yaw)},
        "covariance": None if pose is None else alignment.covariance.tolist(),
        "matches": alignment.matches.tolist(),
        "evidence": _finite(alignment.evidence),
        "margin": _finite(alignment.margin),
        "risk": _finite(alignment.risk),
        "time_offset": None if pose is None else _finite(alignment.time_offset),
        "time_offset_std": None if pose is None else _finite(alignment.time_offset_std),
    }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
