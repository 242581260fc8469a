"""Settings of the detector, and the two shipped configurations."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from cobevglue.settings import Settings

__all__ = ["CONFIGS", "STRIDES", "Anchor", "DetectionConfig", "PointPillarsConfig"]

STRIDES = (2, 4, 8)
"""Strides of the three feature maps, in pillars: each stage of the backbone halves the resolution."""

_Range = tuple[float, float]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Share = Annotated[float, Field(ge=0, le=1)]
_Count = Annotated[int, Field(ge=1)]


class Anchor(Settings):
    """An anchor box, at 0 and at 90 degrees in every cell.

    Attributes:
        length: along the heading [m].
        width: across it [m].
        height: [m].
        z: height of its centre in the LiDAR's frame [m].
    """

    length: _Positive
    width: _Positive
    height: _Positive
    z: Annotated[float, Field(allow_inf_nan=False)]


class DetectionConfig(Settings):
    """Settings of box decoding. Independent of the weights, so they may be changed after training.

    Attributes:
        score_threshold: minimum score of a box.
        candidates: number of boxes of highest score that enter non-maximum suppression.
        nms_iou: maximum rotated IoU of two detections.
        max_detections: maximum number of detections.
        uncertainty_penalty: rank by score * exp(-penalty * standard deviation of x and y [m]) instead of the score; 0
            ranks by the score. The returned scores are not changed.
        variance_voting: replace each detection by the average of all candidates with an IoU of `voting_iou` or more,
            weighted by the IoU and the inverse predicted variance (He et al., "Bounding Box Regression with
            Uncertainty for Accurate Object Detection", CVPR 2019). The direction is decided by a weighted vote, too.
        voting_iou: minimum IoU of candidates in `variance_voting`.
        heading_refinement: classify front and back from the points on each box (`perception/heading.py`).
    """

    score_threshold: _Share = 0.1
    candidates: _Count = 500
    nms_iou: _Share = 0.15
    max_detections: _Count = 120
    uncertainty_penalty: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    variance_voting: bool = False
    voting_iou: _Share = 0.5
    heading_refinement: bool = True


class PointPillarsConfig(Settings):
    """Settings of `PointPillars`: range, size of the network, anchors.

    Attributes:
        x_range: detection range along x, in the LiDAR's frame [m].
        y_range: along y [m].
        z_range: along z [m].
        pillar: side of a pillar [m].
        use_intensity: use the intensity of points; not recommended for sensors with different definitions of it.
        pillar_channels: channels of the pseudo-image, a multiple of 16: on AVX-512 processors torch 2.13 (oneDNN) may
            write beyond its buffers in the backward pass of a first convolution with 12 input channels. Other
            versions of torch were not tried.
        block_layers: residual blocks at strides 2, 4 and 8.
        block_channels: their channels.
        up_channels: channels of each of the three maps after upsampling to stride 2.
        shrink_channels: channels of the input of the head.
        shrink_kernel: kernel of the first of the two convolutions in front of the head; the second is 3 x 3.
        anchors: box sizes in every cell, each at 0 and 90 degrees.
        positive_iou: minimum IoU of an anchor with its object.
        negative_iou: anchors with a smaller IoU with all objects are background; those in between are ignored.
        ignore_iou: anchors with this IoU with an ignored object (too few points) are ignored.
        detection: settings of box decoding.

    Raises:
        ValueError: a value out of range, an unknown field, an empty range, one that is no multiple of 8 pillars, or
            `pillar_channels` that is no multiple of 16.
    """

    x_range: _Range = (-70.4, 70.4)
    y_range: _Range = (-40.0, 40.0)
    z_range: _Range = (-3.0, 1.0)
    pillar: _Positive = 0.4
    use_intensity: bool = False
    pillar_channels: Annotated[int, Field(ge=16)] = 32
    block_layers: tuple[_Count, _Count, _Count] = (1, 2, 2)
    block_channels: tuple[_Count, _Count, _Count] = (48, 96, 128)
    up_channels: _Count = 48
    shrink_channels: _Count = 48
    shrink_kernel: Annotated[int, Field(ge=1, le=3)] = 1
    anchors: Annotated[tuple[Anchor, ...], Field(min_length=1)] = (
        Anchor(length=4.4, width=2.0, height=1.6, z=-1.0),
        Anchor(length=9.0, width=2.6, height=3.3, z=-0.2),
    )
    positive_iou: _Share = 0.5
    negative_iou: _Share = 0.45
    ignore_iou: _Share = 0.2
    detection: DetectionConfig = DetectionConfig()

    @model_validator(mode="after")
    def _check(self) -> PointPillarsConfig:
        for name, count in (("x_range", self.columns), ("y_range", self.rows)):
            low, high = getattr(self, name)
            if not low < high or count % STRIDES[-1] or abs(count * self.pillar - (high - low)) > 1e-6 * (high - low):
                raise ValueError(
                    f"{name}: {low} to {high} m is not a multiple of {STRIDES[-1]} pillars of {self.pillar} m"
                )
        if self.pillar_channels % 16:
            raise ValueError(
                f"pillar_channels: must be a multiple of 16, got {self.pillar_channels}; with others torch 2.13 may "
                "corrupt memory in training on AVX-512 processors (oneDNN's convolution_backward_weights)"
            )
        if not self.z_range[0] < self.z_range[1]:
            raise ValueError(f"z_range: {self.z_range[0]} to {self.z_range[1]} m is empty")
        if self.shrink_kernel == 2:
            raise ValueError("shrink_kernel: must be odd, 1 or 3, got 2")
        if self.negative_iou > self.positive_iou:
            raise ValueError(f"negative_iou: {self.negative_iou} is above positive_iou, {self.positive_iou}")
        return self

    @property
    def rows(self) -> int:
        """Pillars along y: rows of the pseudo-image, from y_min to y_max."""
        return round((self.y_range[1] - self.y_range[0]) / self.pillar)

    @property
    def columns(self) -> int:
        """Pillars along x: columns of the pseudo-image, from x_min to x_max."""
        return round((self.x_range[1] - self.x_range[0]) / self.pillar)

    @property
    def head_shape(self) -> tuple[int, int, int]:
        """Rows, columns and anchors per cell of the output of the head."""
        return self.rows // STRIDES[0], self.columns // STRIDES[0], 2 * len(self.anchors)


_VOTING = DetectionConfig(variance_voting=True)
"""Improves AP at IoU 0.7 by one point on the simulated validation split (`benchmarks/detection_settings.py`)."""

CONFIGS: dict[str, PointPillarsConfig] = {
    "opv2v": PointPillarsConfig(
        x_range=(-140.8, 140.8),
        pillar_channels=64,
        block_layers=(3, 5, 8),
        block_channels=(64, 128, 256),
        up_channels=128,
        shrink_channels=256,
        shrink_kernel=3,
        anchors=(Anchor(length=3.9, width=1.6, height=1.56, z=-1.0),),
        positive_iou=0.6,
        negative_iou=0.45,
        detection=_VOTING,
    ),
    "compact": PointPillarsConfig(detection=_VOTING),
}
"""`opv2v`: the size used in papers on OPV2V (with residual blocks, as in CoAlign and CoBEVGlue), for a GPU. Unlike
there, intensity is not used: in OPV2V's clouds it is a function of the range, which does not hold for real sensors.
`compact`: about a million weights, for a CPU; also for roadside LiDARs, vans, buses and lorries."""
