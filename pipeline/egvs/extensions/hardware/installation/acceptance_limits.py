"""Limits of an accepted sensor, without heavy imports: the command line has them as defaults."""

from __future__ import annotations

from dataclasses import dataclass

MAX_VEHICLE_HEIGHT_M = 4.5
"""Legal heights are 4.0 m in Europe, 3.8 m in Japan and 4.1 to 4.3 m in the United States."""


@dataclass(frozen=True)
class Limits:
    """Limits of an accepted sensor; infinity switches an upper limit off, 0 switches ``returns`` off.

    Attributes
    ----------
    position_m
        Largest distance of the measured from the planned position.
    tilt_deg
        Largest angle of the turn that is left without the error of the yaw.
    yaw_deg
        Largest error of the yaw.
    blocked_deg
        Largest width of all blocked sectors together.
    missing_channels
        Largest number of channels without returns.
    returns
        Smallest share of the expected returns.
    off_beams
        Largest share of returns on no beam of the sensor.
    loss
        Largest loss of the score that ranks, as a share of the planned one.
    """

    position_m: float = 0.3
    tilt_deg: float = 1.0
    yaw_deg: float = 2.0
    blocked_deg: float = 5.0
    missing_channels: float = 0.0
    returns: float = 0.8
    off_beams: float = 0.05
    loss: float = 0.05
