"""What to design for a pole, without heavy imports: the command line has its defaults."""

from __future__ import annotations

from dataclasses import dataclass

ALL_SENSORS = "all"
"""Stands for the sensors of the scenario and the complete catalogue."""

ELEVATION_BOUNDS_DEG = (-45.0, 25.0)
"""Default bounds of free elevations."""


@dataclass(frozen=True)
class DesignRequest:
    """What to design.

    Attributes
    ----------
    pole
        Name of the pole.
    sensors
        Names of sensors, or :data:`ALL_SENSORS`.
    heights_m
        Lowest and highest height above the ground; None for those of the candidates at the pole.
    evaluations
        Number of mounts that are tried for each sensor.
    channels
        Number of free channels; None for no free ones.
    bounds_deg
        Lowest and highest elevation of free channels.
    elevation_evaluations
        Number of sets of elevations that are tried.
    name
        Name of the designed sensor.
    """

    pole: str
    sensors: tuple[str, ...] = (ALL_SENSORS,)
    heights_m: tuple[float, float] | None = None
    evaluations: int = 100
    channels: int | None = None
    bounds_deg: tuple[float, float] = ELEVATION_BOUNDS_DEG
    elevation_evaluations: int = 300
    name: str = "designed"
