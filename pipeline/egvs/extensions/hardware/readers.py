"""Recordings with several sweeps of a LiDAR; see :mod:`egvs.formats.sweep_files`."""

from __future__ import annotations

from egvs.core.readers import Reader

_RECORDINGS = "egvs.extensions.hardware.recordings"

READERS = (
    Reader("ROS", "sweeps", f"{_RECORDINGS}.ros_bags", suffixes=(".bag", ".mcap", ".db3", "metadata.yaml")),
    Reader("Velodyne capture", "sweeps", f"{_RECORDINGS}.velodyne_pcap", suffixes=(".pcap",)),
)
