"""Registration without any pose to start from: FPFH descriptors of points, and the robust motion between matches.

The pipeline that multi-robot systems use: Rusu et al., "Fast Point Feature Histograms (FPFH) for 3D registration" (ICRA
2009) by Open3D, matched where each is the other's nearest, and then TEASER++ where `teaserpp_python` is installed, our
`robust_motion` elsewhere.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from cobevglue.alignment.alignment import Alignment
from cobevglue.alignment.group import Observation
from cobevglue.alignment.registration.points import PointAligner, height_above_ground, one_per_voxel
from cobevglue.alignment.registration.robust import Motion, robust_motion, teaserpp_motion
from cobevglue.se2 import SE2
from cobevglue.typing import FloatArray, IntArray

__all__ = ["FPFHTeaser"]

_VOXEL = 0.5
_NORMAL_RADIUS, _NORMAL_NEIGHBOURS = 1.0, 30
_FEATURE_RADIUS, _FEATURE_NEIGHBOURS = 2.5, 100
_NOISE_BOUND = 0.5
"""How far two points that were matched rightly may be from each other: the voxels' size [m]."""
_MOST_MATCHES = 1000
_FEWEST_POINTS = 10


class FPFHTeaser(PointAligner):
    """The pose that most matched descriptors agree on; refused where too few do. It sees no pose.

    The sketch is what is more than 0.3 m above the ground, one point for each cube of 0.5 m; 6 bytes a point. Only
    points travel: the receiver computes the descriptors of what arrived, as 33 numbers a point would cost 11 times as
    much. The motion is found in space, and its planar part is kept.

    Args:
        budget_bytes: see `PointAligner`.
        min_inliers: how many matches have to agree.

    Raises:
        ValueError: a setting out of its range.
        ModuleNotFoundError: when first used: Open3D is not installed.
    """

    needs = frozenset({"points"})

    def __init__(self, budget_bytes: int | None = None, min_inliers: int = 10) -> None:
        super().__init__(budget_bytes)
        if not min_inliers >= 4:
            raise ValueError(f"min_inliers must be >= 4, as fewer always agree, got {min_inliers}")
        self.min_inliers = min_inliers

    def sketch(self, points: FloatArray) -> FloatArray:
        """(n, 3) what stands on the ground, thinned."""
        standing = points[height_above_ground(points) > 0.3]
        return standing[one_per_voxel(standing, _VOXEL)]

    def align_group(
        self, ego: str, observations: Mapping[str, Observation], time: float | None = None
    ) -> dict[str, Alignment]:
        """Each collaborator by itself."""
        own = self.sketch_of(observations[ego])
        described = _features(own) if len(own) >= _FEWEST_POINTS else None
        found = {}
        for name, observation in observations.items():
            if name != ego:
                points = self.sketch_of(observation)
                few = described is None or len(points) < _FEWEST_POINTS
                found[name] = Alignment.refused("too few points") if few else self._align(own, described, points)
        return found

    def _align(self, ego: FloatArray, described: Any, other: FloatArray) -> Alignment:
        pairs = _matched(described, _features(other))
        motion = _motion(ego[pairs[:, 0]], other[pairs[:, 1]])
        if len(motion.inliers) < self.min_inliers:
            return Alignment.refused(f"{len(motion.inliers)} matched points agree, not {self.min_inliers}")
        ego_SE3_other = np.eye(4)
        ego_SE3_other[:3, :3], ego_SE3_other[:3, 3] = motion.rotation, motion.translation
        return Alignment(SE2.from_matrix(ego_SE3_other))


def _features(points: FloatArray) -> Any:
    """The FPFH descriptors of (n, 3) points in their LiDAR's frame, as Open3D holds them."""
    library = _open3d()
    near = library.geometry.KDTreeSearchParamHybrid
    cloud = library.geometry.PointCloud(library.utility.Vector3dVector(points))
    cloud.estimate_normals(near(_NORMAL_RADIUS, _NORMAL_NEIGHBOURS))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    return library.pipelines.registration.compute_fpfh_feature(cloud, near(_FEATURE_RADIUS, _FEATURE_NEIGHBOURS))


def _matched(ego: Any, other: Any) -> IntArray:
    """(K, 2) rows of points whose descriptors are each other's nearest, the nearest first."""
    match = _open3d().pipelines.registration.correspondences_from_features
    pairs = np.asarray(match(ego, other, mutual_filter=True, mutual_consistency_ratio=0.0)).reshape(-1, 2)
    distance = np.linalg.norm(ego.data[:, pairs[:, 0]] - other.data[:, pairs[:, 1]], axis=0)
    return pairs[np.argsort(distance, kind="stable")[:_MOST_MATCHES]].astype(np.int64)


def _motion(ego: FloatArray, other: FloatArray) -> Motion:
    try:
        import teaserpp_python
    except ImportError:
        return robust_motion(ego, other, _NOISE_BOUND)
    return teaserpp_motion(teaserpp_python, ego, other, _NOISE_BOUND)


@cache
def _open3d() -> Any:
    """Open3D. It wants the system's libusb, in whose place the one of `libusb-package` is loaded first."""
    try:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ModuleNotFoundError, OSError):
        pass  # it may be there
    try:
        import open3d
    except ImportError as error:
        raise ModuleNotFoundError(
            f"FPFH needs Open3D: pip install cobevglue[registration] ({error})", name="open3d"
        ) from None
    return open3d
