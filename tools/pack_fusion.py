"""Create the shipped fusion weights and their model card from training runs.

    python tools/pack_fusion.py compact runs/fusion

reads `runs/fusion/METHOD/last.safetensors` for each method with trainable weights. The weights of methods without a
finished run are kept.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from cobevglue.fusion import FUSION_METHODS, IntermediateFusion
from cobevglue.perception import PointPillars

WEIGHTS = Path(__file__).parent.parent / "src" / "cobevglue" / "fusion" / "weights"


def main() -> None:
    """Write `weights/DETECTOR_METHOD.safetensors` and `weights/DETECTOR.md`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("detector", help="name of the detector's shipped weights")
    parser.add_argument("runs", type=Path, help="folder of the runs, one named after each method")
    arguments = parser.parse_args()
    detector = PointPillars.pretrained(arguments.detector)
    WEIGHTS.mkdir(exist_ok=True)
    rows = []
    for name, method in FUSION_METHODS.items():
        if not issubclass(method, IntermediateFusion):
            continue
        file = WEIGHTS / f"{arguments.detector}_{name}.safetensors"
        run = arguments.runs / name / "last.safetensors"
        if run.is_file() and (trained := method(detector).load(run)).metadata["metrics"]:  # the run is finished
            trained.save(file, half=True)
        if file.is_file():
            rows.append(_row(name, method(detector).load(file), file))
            print(rows[-1])
    (WEIGHTS / f"{arguments.detector}.md").write_text(_CARD.format(detector=arguments.detector, rows="\n".join(rows)))


def _row(name: str, method: IntermediateFusion, file: Path) -> str:
    known = method.metadata
    training = known["training"]
    optimisation = training["optimisation"]
    samples = optimisation["epochs"] * optimisation["samples_per_epoch"]
    noise = training["noise"] or method.training_noise
    scores = [f"{known['metrics'][key]:.3f}" for key in ("ap_0.5", "ap_0.7")]
    cells = [
        f"`{name}`",
        f"{sum(p.numel() for p in method.parameters()) / 1e6:.2f} M",
        f"{file.stat().st_size / 1e6:.2f} MB",
        f"{noise[0]:g} m, {noise[1]:g}°",
        str(samples),
        f"{known['seconds'] / 60:.0f} min",
        *scores,
        f"`{known.get('commit', '')[:8]}`",
    ]
    return "| " + " | ".join(cells) + " |"


_CARD = """# Model card: fusion methods on the `{detector}` detector

The weights of each method's neck, head and fusion layers, in half precision. The detector's pillar encoder and backbone
are frozen and not stored in these files. Each file contains their fingerprint and is rejected for another detector.

- **Data**: simulated drives of the `train` networks only (SUMO traffic, embreex LiDAR; 2 or 3 agents), made by the
  command; no real point clouds were used. Ground truth: objects with at least 5 points from all agents together.
- **Command**: `cobevglue train fusion --config METHOD --out runs/fusion/METHOD`, then
  `python tools/pack_fusion.py {detector} runs/fusion`. Settings, commit, seed, machine and time are in each file's
  header.
- **Poses in training**: true poses with Gaussian noise on every agent (column *noise*), as in the method's paper where
  it gives a value. One sample in five contains only the ego.
- **AP** in the table: 96 frames of the `validation` networks with true poses, objects with at least 5 points, within
  the detector's range. It only verifies that training converged; `docs/results/` has the results for comparing methods.
  `docs/collaboration.md` describes the choice of learning rates.

| method | weights | file | noise | samples | time | AP 0.5 | AP 0.7 | commit |
|---|---|---|---|---|---|---|---|---|
{rows}
"""


if __name__ == "__main__":
    main()
