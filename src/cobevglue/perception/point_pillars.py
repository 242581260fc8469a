"""PointPillars detector with a residual backbone, in plain PyTorch."""

from __future__ import annotations

import difflib
import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import ValidationError
from torch import Tensor, nn

from cobevglue.boxes import Boxes
from cobevglue.perception.anchors import AnchorGrid
from cobevglue.perception.backbone import Backbone, Neck
from cobevglue.perception.checkpoint import load_checkpoint, load_weights, save_checkpoint
from cobevglue.perception.config import PointPillarsConfig
from cobevglue.perception.decode import Detections, decode
from cobevglue.perception.ground_height import correct_height, estimate_height_correction
from cobevglue.perception.head import Head, HeadOutput
from cobevglue.perception.heading import HeadingRefiner, refine_headings
from cobevglue.perception.pillars import PillarEncoder, batch_clouds
from cobevglue.typing import ArrayLike, Float32Array, FloatArray

__all__ = ["PointPillars", "check_points"]

_ARCHITECTURE = "point_pillars"
_WEIGHTS = Path(__file__).parent / "weights"


class PointPillars(nn.Module):
    """Detector of vehicles in point clouds (Lang et al., "PointPillars", CVPR 2019).

        detector = PointPillars.pretrained("compact")
        boxes = detector.detect(points)  # (N, 4) x, y, z, intensity

    `forward` is `decode_features(multiscale(encode(clouds)))`, so that fusion can be applied between the steps. All
    maps are (B, C, rows, columns); rows along y and columns along x, both from min to max. `detect` adds heading
    refinement (`heading_refiner`), a second stage on the points of each detection, which is trained separately.

    Args:
        config: settings; two are in `CONFIGS`. Weights are initialised from torch's random generator.

    Attributes:
        config: the settings.
        detection: settings of box decoding, initially `config.detection`; may be changed at any time.
        anchors: the anchors of the head.
        metadata: of the file that the weights were loaded from.
    """

    def __init__(self, config: PointPillarsConfig) -> None:
        super().__init__()
        self.config = config
        self.detection = config.detection
        self.anchors = AnchorGrid(config)
        self.metadata: dict[str, Any] = {}
        self.pillars = PillarEncoder(config)
        self.backbone = Backbone(config)
        self.neck = Neck(config)
        self.head = Head(config)
        self.heading_refiner = HeadingRefiner()
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # faster convolutions

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self.pillars.linear.weight.device

    def encode(self, clouds: Sequence[Tensor]) -> Tensor:
        """Encode B clouds (N_i, 4) x, y, z [m], intensity as a pseudo-image (B, pillar_channels, rows, columns).

        Points out of range or not finite are dropped; a cloud may be empty.
        """
        points, cloud = batch_clouds([c.to(self.device, torch.float32, non_blocking=True) for c in clouds])
        image: Tensor = self.pillars(points, cloud, len(clouds))
        return image

    def multiscale(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Feature maps of the pseudo-image at strides 2, 4 and 8, which agents share."""
        maps: tuple[Tensor, Tensor, Tensor] = self.backbone(image)
        return maps

    def decode_features(self, maps: Sequence[Tensor]) -> HeadOutput:
        """Output of the head for three maps, of one agent or fused."""
        output: HeadOutput = self.head(self.neck(maps))
        return output

    def forward(self, clouds: Sequence[Tensor]) -> HeadOutput:
        """Output of the head for B clouds (N_i, 4) x, y, z [m], intensity."""
        return self.decode_features(self.multiscale(self.encode(clouds)))

    def boxes(self, output: HeadOutput) -> list[Detections]:
        """Decode the detections of each cloud, by descending score."""
        return decode(output, self.anchors, self.detection)

    def refine_headings(self, detections: Detections, points: Float32Array) -> Detections:
        """Refine the headings of detections in a cloud (N, 4), if `detection.heading_refinement` is set."""
        return (
            refine_headings(detections, points, self.heading_refiner)
            if self.detection.heading_refinement
            else detections
        )

    def detect(self, points: ArrayLike) -> Boxes:
        """Detect the vehicles in one cloud.

        Args:
            points: (N, 4) x, y, z [m], intensity, in the LiDAR's frame. Rows with NaN are dropped. Clouds of sensors
                at unusual heights are normalised first (`estimate_height_correction`).

        Returns:
            Boxes in the LiDAR's frame, by descending score, with score and label.

        Raises:
            ValueError: `points` is not numeric of shape (N, 4).
        """
        return self.detect_batch([points])[0]

    def detect_batch(self, clouds: Sequence[ArrayLike]) -> list[Boxes]:
        """Detect the vehicles in each of several clouds; see `detect`."""
        return [detections.boxes for detections in self._detect(clouds)]

    def detect_with_uncertainty(self, points: ArrayLike) -> tuple[Boxes, FloatArray]:
        """Detect the K vehicles in one cloud, with the (K, 3) variance of x, y [m^2] and yaw [rad^2] of each."""
        detections = self._detect([points])[0]
        return detections.boxes, detections.variance

    @torch.inference_mode()
    def _detect(self, clouds: Sequence[ArrayLike]) -> list[Detections]:
        if not clouds:
            return []
        checked = [check_points(points) for points in clouds]
        offsets = [estimate_height_correction(points) for points in checked]
        normalised = [correct_height(points, z) for points, z in zip(checked, offsets, strict=True)]
        with self._evaluation_mode():
            decoded = self.boxes(self([torch.from_numpy(points) for points in normalised]))
            refined = [self.refine_headings(one, points) for one, points in zip(decoded, normalised, strict=True)]
        return [
            one._replace(boxes=one.boxes.replace(center=one.boxes.center - (0.0, 0.0, z)))
            for one, z in zip(refined, offsets, strict=True)
        ]

    def save(self, path: str | Path, metadata: Mapping[str, Any] | None = None, half: bool = False) -> None:
        """Write settings, weights and metadata atomically to one safetensors file.

        Args:
            path: of the file.
            metadata: data, metrics, seed and the like, JSON-serialisable.
            half: store weights as float16, for half the size.
        """
        config = json.loads(self.config.model_dump_json())
        save_checkpoint(path, _ARCHITECTURE, config, self, {**self.metadata, **(metadata or {})}, half)

    @classmethod
    def load(cls, path: str | Path) -> PointPillars:
        """Load a detector written by `save`, on the CPU and in evaluation mode.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file is damaged, not a checkpoint of CoBEVGlue, or of another format, network or shape.
        """
        checkpoint = load_checkpoint(path, _ARCHITECTURE)
        try:
            config = PointPillarsConfig.model_validate(checkpoint.config)
        except ValidationError as error:
            raise ValueError(f"{path}: settings that this version of cobevglue does not take: {error}") from None
        detector = cls(config)
        load_weights(detector, checkpoint.weights, path)
        detector.metadata = checkpoint.metadata
        return detector.eval()

    @classmethod
    def pretrained(cls, name: str) -> PointPillars:
        """Load a shipped detector by name.

        Raises:
            ValueError: unknown name; the message suggests the most similar one.
        """
        names = sorted(path.stem for path in _WEIGHTS.glob("*.safetensors"))
        if name not in names:
            near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.0)
            hint = f"did you mean {near[0]!r}?" if near else f"{_WEIGHTS} has none"
            raise ValueError(f"no pretrained detector {str(name)!r}; {hint}")
        return cls.load(_WEIGHTS / f"{name}.safetensors")

    @classmethod
    def named(cls, name_or_file: str) -> PointPillars:
        """Load a shipped detector by name, or a detector from a `.safetensors` file.

        Raises:
            ValueError, FileNotFoundError: see `pretrained` and `load`.
        """
        return cls.load(name_or_file) if name_or_file.endswith(".safetensors") else cls.pretrained(name_or_file)

    def export_onnx(self, path: str | Path) -> None:
        """Export the network after the pillar encoder as an ONNX model, from pseudo-image to head output.

        Input `image` (B, pillar_channels, rows, columns) with dynamic B; outputs as named in `HeadOutput`. Pillar
        encoding (`encode`) and decoding (`boxes`) are not part of the model.
        """
        shape = 1, self.config.pillar_channels, self.config.rows, self.config.columns
        names = list(HeadOutput._fields)
        with self._evaluation_mode(), warnings.catch_warnings():
            # The newer exporter needs onnxscript and gives the same graph.
            warnings.simplefilter("ignore", DeprecationWarning)
            torch.onnx.export(
                _DenseNetwork(self).eval(),
                (torch.zeros(shape, device=self.device),),
                str(path),
                input_names=["image"],
                output_names=names,
                dynamic_axes={name: {0: "batch"} for name in ("image", *names)},
                opset_version=17,
                dynamo=False,
            )

    @contextmanager
    def _evaluation_mode(self) -> Iterator[None]:
        """Switch to evaluation mode, and restore the mode on exit."""
        training = self.training
        if training:
            self.eval()
        try:
            yield
        finally:
            if training:
                self.train()


class _DenseNetwork(nn.Module):
    def __init__(self, detector: PointPillars) -> None:
        super().__init__()
        self.detector = detector

    def forward(self, image: Tensor) -> HeadOutput:
        return self.detector.decode_features(self.detector.multiscale(image))


def check_points(points: ArrayLike) -> Float32Array:
    """Convert a point cloud to float32 and drop invalid returns.

    These are points with non-finite coordinates, and points at exactly (0, 0, 0), as which several LiDAR drivers store
    missing returns. A non-finite intensity is replaced by 0.

    Args:
        points: (N, 4) x, y, z [m], intensity, in the LiDAR frame.

    Returns:
        (M, 4) with M <= N, in the same order.

    Raises:
        ValueError: not numeric, or of another shape.
    """
    try:
        array = np.asarray(points)
    except ValueError as error:
        raise ValueError(f"points must have shape (N, 4): {error}") from None
    if array.dtype.kind not in "iuf":
        raise ValueError(f"points must be numbers, got {array.dtype}")
    if array.size == 0 and array.ndim == 1:
        array = array.reshape(0, 4)
    if array.ndim != 2 or array.shape[1] != 4:
        raise ValueError(f"points must have shape (N, 4): x, y, z [m], intensity; got {array.shape}")
    with np.errstate(over="ignore"):  # values too large for float32 become infinite and are dropped
        cloud = np.array(array, dtype=np.float32, order="C")
    cloud[~np.isfinite(cloud[:, 3]), 3] = 0.0
    valid: Float32Array = cloud[np.isfinite(cloud[:, :3]).all(axis=1) & (cloud[:, :3] != 0.0).any(axis=1)]
    return valid
