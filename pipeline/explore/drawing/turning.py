"""Angles of a mount as the quaternion that a gizmo has, and back.

R_world_sensor = Rz(yaw) Ry(-pitch) Rx(roll), as :func:`pipeline.sensing.sensors.rotation` builds it; a quaternion is
(w, x, y, z) of length 1. Positions are whole millimetres and angles whole hundredths of a degree: nobody drags finer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict

from pipeline.sensing.sites import Pose

_LENGTH_DIGITS, _ANGLE_DIGITS = 3, 2
_STEEPEST = 1.0 - 1e-9
"""Sine of the pitch above which yaw and roll turn about the same axis; roll is 0 there."""

Quaternion = tuple[float, float, float, float]


def quaternion(pose: Pose) -> Quaternion:
    """How a mount is turned, (w, x, y, z)."""
    yaw, pitch, roll = (math.radians(angle) / 2.0 for angle in (pose.yaw_deg, -pose.pitch_deg, pose.roll_deg))
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(half), math.sin(half)) for half in (yaw, pitch, roll))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def angles_deg(wxyz: Sequence[float]) -> tuple[float, float, float]:
    """(yaw, pitch, roll) of a quaternion, of any length above 0."""
    length = math.hypot(*wxyz)
    w, x, y, z = (value / length for value in wxyz)
    sine = max(-1.0, min(1.0, 2.0 * (x * z - w * y)))  # of the pitch, nose up
    if abs(sine) > _STEEPEST:
        yaw = math.atan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (x * x + z * z))
        return math.degrees(yaw), math.copysign(90.0, sine), 0.0
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return math.degrees(yaw), math.degrees(math.asin(sine)), math.degrees(roll)


def moved(pose: Pose, position_m: Sequence[float], wxyz: Sequence[float]) -> Pose:
    """A pose after a drag, rounded; what was not dragged stays to the last digit."""
    values = dict(zip(("x_m", "y_m", "z_m"), position_m, strict=True))
    values |= dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), angles_deg(wxyz), strict=True))
    return Pose(**{name: _settled(name, before, values[name]) for name, before in asdict(pose).items()})


def _settled(name: str, before: float, after: float) -> float:
    is_angle = name.endswith("_deg")
    digits = _ANGLE_DIGITS if is_angle else _LENGTH_DIGITS
    away = math.remainder(after - before, 360.0) if is_angle else after - before
    return before if abs(away) <= 0.5 * 10.0**-digits else round(float(after), digits) + 0.0
