"""Average precision over bytes of CoBEVGlue's features, on validation sequences: `python benchmarks/bandwidth.py`.

Settings of `cobevglue.fusion.Compression`, and principal components of the channels in their place: a 1 x 1 convolution
at the sender and its transpose at the receiver, from sequences of the training split. Poses are the true ones, so that
only features matter. Bytes are those of the encoded features, a collaborator and frame.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch

from cobevglue.alignment import group_aligner
from cobevglue.boxes import Boxes
from cobevglue.evaluation.detection import evaluate_detections
from cobevglue.evaluation.detection_matching import DetectionFrame
from cobevglue.experiments.models import Models
from cobevglue.experiments.observed_sequence import ObservedSequence
from cobevglue.experiments.study import StudySettings, open_sequence, sequence_frames
from cobevglue.fusion import CompressedFusion, Compression, FusionMethod, Received
from cobevglue.fusion.compression import compress, decompress, most_confident
from cobevglue.messages import Arrays
from cobevglue.perception import PerceptionOutput
from cobevglue.system import CoBEVGlue
from cobevglue.typing import Float32Array
from common import print_head

EVERY = 5  # frames of a sequence, so that they differ
SETTINGS = [(b, 1.0) for b in (8, 6, 4, 3, 2)] + [(b, c) for b in (4, 3, 2) for c in (0.3, 0.1, 0.05, 0.02, 0.01)]
COMPONENTS = [(8, 0.5, 1.0), (8, 0.25, 1.0), (5, 0.25, 1.0), (5, 0.25, 0.05)]


class PrincipalComponents(CompressedFusion):
    """Features reduced to their first principal components before they are quantised.

    Args:
        method: whose maps are sent.
        compression: of the components.
        bases: of each map the mean (C,) and the components (C, K).
    """

    def __init__(
        self, method: FusionMethod, compression: Compression, bases: Sequence[tuple[Float32Array, Float32Array]]
    ) -> None:
        super().__init__(method, compression)
        self.bases = bases

    def message(self, observation: PerceptionOutput) -> Arrays:
        """Encode the principal components in place of the channels."""
        maps = {
            name: np.einsum("ck,chw->khw", basis, values.astype(np.float32) - mean[:, None, None]).astype(np.float16)
            for (name, values), (mean, basis) in zip(self.method.message(observation).items(), self.bases, strict=True)
        }
        cells = None
        if self.compression.cells < 1.0:
            cells = most_confident(self.method.confidence(observation), self.compression.cells)
        return compress(maps, self.compression.bits, cells)

    def fuse(self, ego: PerceptionOutput, received: Sequence[Received]) -> Boxes:
        """The method's boxes from the channels that the components stand for; none is negative, after a ReLU."""
        return self.method.fuse(ego, [replace(other, content=self._channels(other.content)) for other in received])

    def _channels(self, content: Arrays) -> Arrays:
        parts = dict(decompress(content))
        for number, (mean, basis) in enumerate(self.bases):
            values = np.einsum("ck,khw->chw", basis, parts[f"map{number}"]) + mean[:, None, None]
            parts[f"map{number}"] = np.maximum(values, 0.0).astype(np.float32)
        return parts


def observed(models: Models, split: str, seed: int, sequences: int, frames: int) -> Iterator[ObservedSequence]:
    """Return every fifth frame of the sequences with the observations of all agents."""
    settings = StudySettings(split=split, seed=seed, frames=EVERY * frames)
    for number in range(sequences):
        sequence = ObservedSequence(models.detector)
        sequence.observe(list(sequence_frames(settings, open_sequence(settings, number)))[::EVERY])
        yield sequence


def principal_components(
    sequences: Sequence[ObservedSequence], share: float
) -> list[tuple[Float32Array, Float32Array]]:
    """Of each map the mean and the first components of its channels, this share of them."""
    bases = []
    for scale in range(3):
        maps = [o.features[scale] for s in sequences for f in s.frames for o in f.observations.values()]
        values = np.concatenate([m.flatten(1).numpy() for m in maps], axis=1)
        _, vectors = np.linalg.eigh(np.cov(values))
        basis = vectors[:, ::-1][:, : max(1, round(share * len(values)))]
        bases.append((values.mean(axis=1).astype(np.float32), basis.astype(np.float32)))
    return bases


def row(models: Models, sequences: Sequence[ObservedSequence], method: FusionMethod) -> str:
    """Bytes, their logarithm, and average precision at IoU 0.5 and 0.7."""
    scenes, sent = [], []
    for sequence in sequences:
        system = CoBEVGlue(models.detector, method, group_aligner("given"))
        for frame, truth in zip(sequence.frames, sequence.truth, strict=True):
            out = system.collaborate(frame.observations, sequence.ego, frame.time, frame.true)
            boxes = out.boxes.replace(label=None, track_id=None)
            scenes.append(DetectionFrame(boxes, truth.objects, truth.point_count, truth.timestamp))
            sent += [parts["features"] for parts in out.message_bytes.values()]
    report = evaluate_detections(iter(scenes), (0.5, 0.7), models.evaluation_range, 5, range_bins=())
    size = float(np.mean(sent))
    return f"{size:,.0f} | {np.log2(size) if size else 0:.1f} | {report.ap(0.5):.3f} | {report.ap(0.7):.3f} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--method", default="cobevglue", help="a fusion method that shares maps")
    parser.add_argument("--sequences", type=int, default=12)
    parser.add_argument("--frames", type=int, default=4, help="of each sequence")
    parser.add_argument("--seed", type=int, default=77)
    options = parser.parse_args()
    torch.set_num_threads(1)
    models = Models(StudySettings())
    method = models.method(options.method)
    sequences = list(observed(models, "validation", options.seed, options.sequences, options.frames))
    frames = sum(len(sequence.frames) for sequence in sequences)
    print_head(f"{options.method}, {frames} frames, seed {options.seed}")
    print("| features | cells | bytes | log2 | AP 0.5 | AP 0.7 |\n|---|---:|---:|---:|---:|---:|")
    print("| no collaboration | |", row(models, sequences, models.method("none")), flush=True)
    print("| float16 | 1 |", row(models, sequences, method), flush=True)
    for bits, cells in SETTINGS:
        compressed = CompressedFusion(method, Compression(bits=bits, cells=cells))
        print(f"| {bits} bits | {cells:g} |", row(models, sequences, compressed), flush=True)
    training = list(observed(models, "train", options.seed, 5, 2))
    for bits, share, cells in COMPONENTS:
        reduced = PrincipalComponents(
            method, Compression(bits=bits, cells=cells), principal_components(training, share)
        )
        print(f"| {share:g} of the components, {bits} bits | {cells:g} |", row(models, sequences, reduced), flush=True)


if __name__ == "__main__":
    main()
