"""How the settings of `DetectionConfig` were chosen: on the simulated validation split, and nothing else.

    python benchmarks/detection_settings.py --weights runs/compact/last.safetensors --clouds 120

The network runs once on each cloud; then each setting is changed on its own, beside the others as they are.
"""

from __future__ import annotations

import argparse
from typing import Any

import torch

from cobevglue.evaluation.detection import evaluate_detections
from cobevglue.evaluation.detection_data import Cloud, simulated_clouds
from cobevglue.evaluation.detection_matching import DetectionFrame
from cobevglue.perception import PointPillars
from cobevglue.perception.config import DetectionConfig
from cobevglue.perception.head import HeadOutput
from cobevglue.simulation.episodes import SimulatedEpisodes
from common import print_head

RANGE = (-70.0, 70.0, -39.0, 39.0)
MIN_POINTS = 5
CHANGES: tuple[dict[str, Any], ...] = (
    {},
    {"uncertainty_penalty": 0.25},
    {"uncertainty_penalty": 0.5},
    {"uncertainty_penalty": 1.0},
    {"uncertainty_penalty": 2.0},
    {"variance_voting": True, "voting_iou": 0.3},
    {"variance_voting": True, "voting_iou": 0.5},
    {"variance_voting": True, "voting_iou": 0.7},
    {"variance_voting": True, "uncertainty_penalty": 0.5},
    {"variance_voting": True, "uncertainty_penalty": 1.0},
    {"nms_iou": 0.05},
    {"nms_iou": 0.1},
    {"nms_iou": 0.2},
    {"nms_iou": 0.3},
    {"score_threshold": 0.05},
    {"score_threshold": 0.2},
)


def main() -> None:
    """Print one row for each change."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default="compact", help="a shipped name, or a .safetensors file")
    parser.add_argument("--clouds", type=int, default=120)
    arguments = parser.parse_args()
    detector = PointPillars.named(arguments.weights)
    usual = detector.detection
    print_head(f"weights {arguments.weights}")
    seen: list[tuple[Cloud, HeadOutput]] = []
    with torch.inference_mode():
        for cloud in simulated_clouds(SimulatedEpisodes("validation"), arguments.clouds):
            assert cloud.points is not None
            seen.append((cloud, detector([torch.from_numpy(cloud.points)])))
    print("| change | AP 0.5 | AP 0.7 | flipped |\n|---|---|---|---|")
    for change in CHANGES:
        detector.detection = DetectionConfig.model_validate({**usual.model_dump(), **change})
        frames = [frame(cloud, output, detector) for cloud, output in seen]
        report = evaluate_detections(frames, evaluation_range=RANGE, min_points=MIN_POINTS)
        print(
            f"| {change or 'as it is'} | {report.ap(0.5):.4f} | {report.ap(0.7):.4f} | {report.errors.flipped:.3f} |",
            flush=True,
        )


def frame(cloud: Cloud, output: HeadOutput, detector: PointPillars) -> DetectionFrame:
    """Decode the network's output with these detection settings."""
    assert cloud.points is not None
    (found,) = detector.boxes(output)
    boxes = detector.refine_headings(found, cloud.points).boxes
    return DetectionFrame(boxes, cloud.truth, cloud.point_count, cloud.frame, cloud.agent)


if __name__ == "__main__":
    main()
