"""Makes the fusion weights that come with the package from training runs, and the card that says how they came about.

    python tools/pack_fusion.py compact runs/fusion

takes `runs/fusion/METHOD/last.safetensors` of every method that learns; those without a finished run keep what they
have.
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
        if run.is_file() and (trained := method(detector).load(run)).metadata["metrics"]:  # it was finished
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

What each method has beyond the detector: neck, head and its own layers, in half precision. The detector's pillars and
backbone are frozen and not in these files; a file has their fingerprint, and is refused by a detector with others.

- **Data**: simulated drives of the `train` networks only (SUMO traffic, embreex LiDAR; 2 or 3 agents), made by the
  command; no real cloud was used. Truth: objects that all agents together have at least 5 points on.
- **Command**: `cobevglue train fusion --config METHOD --out runs/fusion/METHOD`, then
  `python tools/pack_fusion.py {detector} runs/fusion`. Settings, commit, seed, machine and time are in each file's
  header.
- **Poses in training**: true ones with Gaussian noise on every agent (column *noise*), as the method's paper has it
  where it says so. One sample in five has nobody but the ego in it.
- **AP** below: 96 frames of the `validation` networks on true poses, objects with at least 5 points, range of the
  detector; a check that training went well. The figures to compare methods by are in `docs/results/`;
  how learning rates were chosen is in `docs/collaboration.md`.

| method | weights | file | noise | samples | time | AP 0.5 | AP 0.7 | commit |
|---|---|---|---|---|---|---|---|---|
{rows}
"""


if __name__ == "__main__":
    main()
