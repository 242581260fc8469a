"""Create the shipped detector weights from a training run: half precision, with the training history as metadata.

    python tools/pack_weights.py compact runs/compact/last.safetensors [runs/stage1/last.safetensors …]

Further files are the earlier runs that it was initialised from (`init_from`) in order, or their packed weights; commit,
command and settings of each are stored. The training of heading refinement (`train heading`) stores those of its
detector itself; `--heading-refiner` copies the heading refiner of another file. The detection settings are not part of
training and are taken from `CONFIGS`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from cobevglue.perception import CONFIGS, PointPillars

WEIGHTS = Path(__file__).parent.parent / "src" / "cobevglue" / "perception" / "weights"


def main() -> None:
    """Write `weights/NAME.safetensors`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=sorted(CONFIGS))
    parser.add_argument("weights", type=Path)
    parser.add_argument("started_from", type=Path, nargs="*")
    parser.add_argument("--heading-refiner", type=Path)
    arguments = parser.parse_args()
    trained = PointPillars.load(arguments.weights)
    config = CONFIGS[arguments.name]
    if trained.config.model_copy(update={"detection": config.detection}) != config:
        raise SystemExit(f"{arguments.weights}: is not of the configuration {arguments.name}")
    detector = PointPillars(config)
    detector.load_state_dict(trained.state_dict())
    last = trained.metadata
    stages: list[dict[str, Any]] = []
    for path in arguments.started_from:
        metadata = PointPillars.load(path).metadata
        stages += metadata.get("stages", [metadata])
    WEIGHTS.mkdir(exist_ok=True)
    file = WEIGHTS / f"{arguments.name}.safetensors"
    stages += last.pop("stages", [])
    if arguments.heading_refiner is not None:
        stages.append(last)
        looking = PointPillars.load(arguments.heading_refiner)
        detector.heading_refiner.load_state_dict(looking.heading_refiner.state_dict())
        last = {key: value for key, value in looking.metadata.items() if key != "stages"}
    detector.save(file, {"stages": [*stages, last]}, half=True)
    print(f"{file}: {file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
