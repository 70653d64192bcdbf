"""Options for reading recordings of sweeps; this module imports no library that reads them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RecordingOptions:
    """What is read of a recording.

    Attributes
    ----------
    topic
        Name of the ROS topic; None for the only one with point clouds.
    max_sweeps
        Most sweeps that are read, spread evenly over the recording.
    range_m
        Returns of a network capture beyond this range are dropped by its decoder.
    """

    topic: str | None = None
    max_sweeps: int = 20
    range_m: float = 500.0
