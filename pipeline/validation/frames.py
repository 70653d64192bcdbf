"""Frames of recorded traffic, as validation takes them."""

from pipeline.artefacts.traffic_frames import TrafficFrame

__all__ = ["TrafficFrame"]
