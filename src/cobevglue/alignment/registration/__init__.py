"""Registration of point clouds, the baselines that BEVGlue is compared with. The libraries are imported when used."""

from cobevglue.alignment.registration.fpfh import FPFHTeaser
from cobevglue.alignment.registration.icp import ICP2D, ICP3D

__all__ = ["ICP2D", "ICP3D", "FPFHTeaser"]
