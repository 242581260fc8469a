"""Replay of recorded drives: from the object lists of a recording to alignments and fused objects."""

from cobevglue.replay.replay import Replay, ReplayFrame

__all__ = ["Replay", "ReplayFrame"]
