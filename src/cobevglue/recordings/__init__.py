"""Recordings of ROS, read and written without ROS by rosbags: `pip install 'cobevglue[ros]'`."""

from cobevglue.recordings.reader import Recording, Topic, open_recording
from cobevglue.recordings.writer import DetectionBag, new_detection_bag

__all__ = ["DetectionBag", "Recording", "Topic", "new_detection_bag", "open_recording"]
