"""Random search for the settings of a peer method on half of the development sequences.

    PYTHONPATH=benchmarks python -m peers.search            # all peers, a few minutes
    PYTHONPATH=benchmarks python -m peers.search CBM VIPS

Data: V2V4Real train 0000 to 0005 (`v2v4real_sequences`, seed 0), every fifth frame with at least two co-visible
objects, independently of the other frames. Criterion: share of right frames minus three times the share of wrong
frames. The first row is the published settings, followed by the best of 60 draws, for which each setting is drawn
independently from its choices in `SPACES`. The best settings of all are the defaults of the classes.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cobevglue.evaluation.alignment import AlignmentSequence, Summary, evaluate, summarise
from cobevglue.evaluation.alignment_data import V2V4REAL_TRAIN, v2v4real_sequences
from common import DATA, print_head
from peers import PEERS, SingleFrameMatcher

SEARCHED_ON = V2V4REAL_TRAIN[:6]
DRAWS, SEED, EVERY = 60, 0, 5
WRONG_COSTS = 3.0

Settings = Mapping[str, Any]

SPACES: dict[str, Mapping[str, Sequence[Any]]] = {
    "FreeAlign": {
        "anchor_tolerance": (0.3, 0.6, 1.0, 1.5, 2.0, 3.0),
        "box_tolerance": (0.5, 1.0, 1.5, 2.0, 3.0, 4.0),
        "min_anchors": (2, 3, 4, 5),
        "inlier_distance": (0.5, 0.75, 1.0, 1.5, 2.0),
    },
    "VIPS": {
        "size_rate": (0.02, 0.1, 0.5, 2.0),
        "distance_rate": (0.1, 0.25, 0.5, 1.0, 2.0, 4.0),
        "heading_rate": (0.1, 1.0, 3.0, 10.0, 30.0),
        "heading_share": (0.0, 0.1, 0.25, 0.5, 0.75),
        "threshold": (0.1, 0.3, 0.5, 0.7, 0.8, 0.9),
        "min_matches": (2, 3, 4, 5),
    },
    "V2XReg": {
        "max_boxes": (15, 25, 40),
        "distance": (0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0),
        "min_affinity": (1.0, 1.5, 2.0, 2.5, 3.0, 4.0),
        "few": (0.0, 2.0, 3.0, 5.0, 10.0),
        "half_turns": (False, True),
    },
    "CBM": {
        "angle": tuple(math.radians(a) for a in (5.0, 10.0, 15.0, 20.0, 30.0)),
        "position": (1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
        "consensus": (0.3, 0.4, 0.5, 0.6, 0.75, 0.9),
        "max_distance": (0.5, 0.75, 1.0, 1.5, 20.0),
        "min_matches": (2, 3, 4, 5),
    },
    "Clipper": {
        "sigma": (0.2, 0.4, 0.8, 1.2, 2.0),
        "epsilon": (0.6, 1.0, 1.5, 2.0, 3.0),
        "min_distance": (0.0, 2.0, 5.0),
        "heading": tuple(math.radians(a) for a in (5.0, 10.0, 15.0, 20.0, 90.0)),
        "min_matches": (2, 3, 4, 5),
    },
}
"""Choices for each setting of each peer."""


def main() -> None:
    """Search and print the best settings of each peer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("peers", nargs="*", metavar="PEER", help=f"of {', '.join(PEERS)}; default: all")
    parser.add_argument("--draws", type=int, default=DRAWS)
    arguments = parser.parse_args()
    frames = frames_to_search_on(DATA)
    print_head(f"seed {SEED}, {arguments.draws} draws, {len(frames)} frames")
    for name in arguments.peers or PEERS:
        results = search(PEERS[name], SPACES[name], frames, arguments.draws)
        print(f"## {name}\n")
        show("published", *results[0])
        for settings, summary in sorted(results[1:], key=lambda result: -criterion(result[1]))[:5]:
            show("drawn", settings, summary)
        print(flush=True)


def frames_to_search_on(data: Path) -> list[AlignmentSequence]:
    """Return the frames for the search, each as a separate sequence."""
    frames = [
        AlignmentSequence(sequence.name, [frame])
        for sequence in v2v4real_sequences(data / "v2v4real_detections", SEARCHED_ON)
        for frame in sequence.frames
        if frame.co_visible >= 2
    ]
    return frames[::EVERY]


def search(
    peer: type[SingleFrameMatcher], space: Mapping[str, Sequence[Any]], frames: list[AlignmentSequence], draws: int
) -> list[tuple[Settings, Summary]]:
    """Evaluate the published settings and `draws` random settings; results are in the order of the draws."""
    rng = np.random.default_rng(SEED)
    drawn = [{name: choices[int(rng.integers(len(choices)))] for name, choices in space.items()} for _ in range(draws)]
    published = dataclasses.asdict(peer.published())  # type: ignore[call-overload]
    return [
        (settings, summarise(evaluate(frames, lambda s=settings: peer(**s))))  # type: ignore[misc]
        for settings in [published, *drawn]
    ]


def criterion(summary: Summary) -> float:
    """Return the share of right frames minus `WRONG_COSTS` times the share of wrong frames."""
    wrong = 1.0 - summary.refused - summary.right
    return summary.right - WRONG_COSTS * wrong


def show(what: str, settings: Settings, summary: Summary) -> None:
    """Print one line of results."""
    values = ", ".join(f"{name}={value:.4g}" for name, value in settings.items())
    wrong = 1.0 - summary.refused - summary.right
    print(f"- {what}: criterion {criterion(summary):.3f} (right {summary.right:.3f}, wrong {wrong:.3f}): {values}")


if __name__ == "__main__":
    main()
