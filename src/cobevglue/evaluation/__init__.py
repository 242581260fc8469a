"""Evaluation of detections and alignments against the ground truth."""
