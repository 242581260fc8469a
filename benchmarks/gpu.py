"""Speed of the detectors on a GPU, and agreement with the CPU: `python benchmarks/gpu.py`.

Times are medians over simulated clouds of the validation split, one cloud at a time as a vehicle has them, and eight at
once; a step of training is forward, backward and optimiser. Boxes found on the GPU are compared with those on the CPU.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch

from cobevglue.iou import bev_iou
from cobevglue.perception import CONFIGS, DetectionLoss, Perception, PointPillars
from cobevglue.simulation.episodes import SimulatedEpisodes
from cobevglue.training.batches import Batches
from cobevglue.training.config import PRESETS
from cobevglue.training.optimisation import Learner, autocast
from common import print_head

REPEATS = 30


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--models", nargs="+", default=["compact", "opv2v"], help="names, or .safetensors files")
    parser.add_argument("--batch", type=int, nargs="+", default=[8, 16, 32], help="samples in a step of training")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    print_head(name, f"torch {torch.__version__}")
    clouds = [cloud.points for cloud in SimulatedEpisodes("validation").episode(0)][:16]
    for model in arguments.models:
        detector = PointPillars.named(model)
        print(f"\n## {model}\n")
        agreement(detector, clouds, device)
        speed(detector.to(device), clouds, arguments.repeats)
        if model in CONFIGS:
            for batch in arguments.batch:
                training(model, batch, device, arguments.repeats)


def agreement(detector: PointPillars, clouds: list[np.ndarray], device: torch.device) -> None:
    """How far boxes found on the device are from those found on the CPU."""
    ours = detector.cpu().detect_batch(clouds[:4])
    theirs = detector.to(device).detect_batch(clouds[:4])
    same, count, off, score = 0, 0, 0.0, 0.0
    for a, b in zip(ours, theirs, strict=True):
        assert a.score is not None
        assert b.score is not None
        count += len(a)
        if not len(a) or not len(b):
            continue
        iou = bev_iou(a, b)
        best = iou.argmax(axis=1)
        found = np.flatnonzero(iou.max(axis=1) > 0.7)
        same += len(found)
        off = max(off, float(np.abs(a.center[found] - b.center[best[found]]).max(initial=0.0)))
        score = max(score, float(np.abs(a.score[found] - b.score[best[found]]).max(initial=0.0)))
    print(
        f"{same} of {count} boxes found on the CPU are found on {device}; centres differ by up to {off:.4f} m, "
        f"scores by {score:.4f}"
    )


def speed(detector: PointPillars, clouds: list[np.ndarray], repeats: int) -> None:
    """Milliseconds for a cloud."""
    device = detector.device
    tensors = [torch.from_numpy(points).to(device) for points in clouds]
    for precision in (torch.float32, torch.bfloat16):
        for size in (1, 8):

            def forward(size: int = size, precision: torch.dtype = precision) -> None:
                with torch.inference_mode(), torch.autocast(device.type, precision, enabled=precision != torch.float32):
                    detector(tensors[:size])

            print(f"network, {precision}, {size} at once: {timed(forward, device, repeats) / size:.2f} ms a cloud")
    perception, stages = Perception(detector), []
    for number in range(repeats + 3):
        start = time.perf_counter()
        seconds = perception.step(clouds[number % len(clouds)]).seconds
        stages.append({**seconds, "all": time.perf_counter() - start})
    listed = {stage: 1e3 * float(np.median([one[stage] for one in stages[3:]])) for stage in stages[0]}
    print("Perception.step [ms]: " + ", ".join(f"{stage} {value:.2f}" for stage, value in listed.items()))


def training(model: str, batch: int, device: torch.device, repeats: int) -> None:
    """Measure training throughput [samples/s] without data loading."""
    config = PRESETS[model]
    ready = Batches(config.model, config.data.min_points, config.augmentation)
    random = np.random.default_rng(0)
    samples = SimulatedEpisodes("train").episode(0)
    items = ready.collate([ready.prepare(samples[i % len(samples)], random) for i in range(batch)])
    detector = PointPillars(config.model).to(device).train()
    detector.heading_refiner.requires_grad_(False)
    loss, learner = DetectionLoss(config.model), Learner(detector, config.optimisation)

    def step() -> None:
        with autocast(config.optimisation, device):
            output = detector(items.clouds(device))
        learner.learn(loss(output, items.targets.to(device)).total, 1, 1000)

    taken = timed(step, device, repeats)
    memory = torch.cuda.max_memory_allocated(device) / 2**30 if device.type == "cuda" else float("nan")
    print(f"training, {batch} at once: {1e3 * batch / taken:.0f} samples/s, {memory:.1f} GiB")


def timed(action: Callable[[], None], device: torch.device, repeats: int) -> float:
    """Median [ms]."""
    taken = []
    for _ in range(repeats + 3):
        start = time.perf_counter()
        action()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        taken.append(1e3 * (time.perf_counter() - start))
    return float(np.median(taken[3:]))


if __name__ == "__main__":
    main()
