r"""How a sensor is mounted at a place: at which heights, turned and tilted so, or aimed at a point.

A place with several heights or pitches is as many candidates; every combination is one. A sensor is *aimed* when its
middle ray meets a point: the ray at the middle of its elevations and of its azimuths (:attr:`Sensor.middle_deg`). With
:math:`m` that ray after the roll, and :math:`d` the unit vector from the sensor to the point, pitch and yaw follow from
the order of turns (roll, pitch, yaw):

.. math:: \rho \sin(pitch + \phi) = d_z, \quad \rho = \sqrt{m_x^2 + m_z^2}, \quad \phi = atan2(m_z, m_x), \\
          yaw = atan2(d_y, d_x) - atan2(m_y, m'_x), \quad m'_x = \rho \cos(pitch + \phi)

Of the two pitches that satisfy this the one is taken that keeps the sign of :math:`m_x`: a window that looks backwards
stays behind the sensor, which is then turned round and not upside down.

So a sensor without roll whose middle azimuth is 0 has a pitch of the point's elevation less the middle elevation. Both
angles are rounded to 1e-6 degree, so that the last bits of an arc tangent do not travel on.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from scipy.special import cosdg, sindg

from pipeline.core.errors import InputError
from pipeline.scenario.models import Scenario, SitesModel
from pipeline.sensing.sensors import Sensor

Pitch = float | Literal["aim"]
Spot = tuple[float, float, float]

_DIGITS = 6
_NEAREST_M = 1e-6
"""A point nearer than this to the plumb line through the sensor has no azimuth."""


@dataclass(frozen=True)
class Mount:
    """One way to mount a sensor at a place; ``mark`` tells it from the others there, and is empty for the only one."""

    mark: str
    z_m: float
    yaw_deg: float
    pitch_deg: float


@dataclass(frozen=True)
class Wishes:
    """What is said of a place in its own row: numbers, an aim; what is not said is None.

    ``heights_m`` are those of the rule that the place comes from, or the one of its row.
    """

    x_m: float
    y_m: float
    heights_m: tuple[float, ...]
    yaw_deg: float | None = None
    pitch_deg: float | None = None
    roll_deg: float = 0.0
    aim_m: Spot | None = None


def mounts(place: str, own: Wishes, scenario: Scenario, sensor: Callable[[], Sensor], used: set[str]) -> list[Mount]:
    """Every combination of height and pitch of a place, the heights one after another.

    Parameters
    ----------
    place
        For messages.
    own
        What the place says of itself; the rest is as under ``[sites]``.
    sensor
        Asked where the sensor is aimed.
    used
        Takes the keys of ``[sites]`` that act here.

    Raises
    ------
    InputError
        For a pitch that needs an aim, or an aim that no mount meets.
    """
    model = scenario.sites
    heights_m = own.heights_m
    if not heights_m and model.heights_m:
        used.add("heights_m")
        heights_m = model.heights_m
    aim_m = own.aim_m or (aim_of(scenario, used) if own.yaw_deg is None else None)
    pitches = (own.pitch_deg,) if own.pitch_deg is not None else _pitches(model, aim_m is not None, used)
    found = []
    for z_m in heights_m:
        at_m = own.x_m, own.y_m, z_m
        aimed = None if aim_m is None else angles_to(place, at_m, aim_m, own.roll_deg, sensor())
        for pitch in pitches:
            if pitch == "aim" and aimed is None:
                why = "nothing says at what" if own.yaw_deg is None else f"a yaw_deg of its own, {own.yaw_deg:g}"
                raise InputError(f"{place}: pitch_deg", f"'aim', but {why}", 'aim = "roi", or aim_m')
            yaw_deg = aimed[0] if aimed else own.yaw_deg if own.yaw_deg is not None else model.yaw_deg or 0.0
            pitch_deg = aimed[1] if pitch == "aim" and aimed else float(pitch)
            mark = _mark(z_m if len(heights_m) > 1 else None, pitch if len(pitches) > 1 else None)
            found.append(Mount(mark, z_m, yaw_deg, pitch_deg))
    return found


def aim_of(scenario: Scenario, used: set[str]) -> Spot | None:
    """The point that ``[sites]`` aims at: the middle of the region of interest, or a point whose z may be left out."""
    model, middle = scenario.sites, scenario.roi.center_m
    if model.aim is None and model.aim_m is None:
        return None
    used.add("aim" if model.aim is not None else "aim_m")
    x_m, y_m, *height = model.aim_m or middle
    return x_m, y_m, height[0] if height else middle[2]


def idle_keys(model: SitesModel, used: set[str]) -> list[str]:
    """The keys of ``[sites]`` that are given and act on no site."""
    return [key for key in ("aim", "aim_m", "heights_m", "pitch_deg") if _given(model, key) and key not in used]


def _given(model: SitesModel, key: str) -> bool:
    return getattr(model, key) not in (None, ())


def _pitches(model: SitesModel, has_aim: bool, used: set[str]) -> tuple[Pitch, ...]:
    """Those of ``[sites]``; else the aim's, or 0."""
    if model.pitch_deg is None:
        return ("aim",) if has_aim else (0.0,)
    used.add("pitch_deg")
    return model.pitch_deg if isinstance(model.pitch_deg, tuple) else (model.pitch_deg,)


def _mark(z_m: float | None, pitch: Pitch | None) -> str:
    """What a candidate's name has after the place's: ``@4.5m-10deg``, ``@aim``; only what others there differ in."""
    height = "" if z_m is None else f"{z_m:.10g}m"
    tilt = "" if pitch is None else "+aim" if pitch == "aim" else f"{pitch + 0.0:+.10g}deg"
    return f"@{height}{tilt}".replace("@+", "@") if height or tilt else ""


def angles_to(place: str, from_m: Spot, to_m: Spot, roll_deg: float, sensor: Sensor) -> tuple[float, float]:
    """Yaw and pitch, degrees, at which the middle ray of a sensor at ``from_m`` meets ``to_m``; see the module.

    Raises
    ------
    InputError
        Where the point is straight above or below the sensor, or no pitch between -90 and 90 lets the ray meet it.
    """
    target = f"({', '.join(f'{v:g}' for v in to_m)})"
    x, y, z = (to - at for to, at in zip(to_m, from_m, strict=True))
    level_m = math.hypot(x, y)
    if level_m < _NEAREST_M:
        raise InputError(f"{place}: aim", f"{target} lies on the plumb line through the sensor", "a point beside it")
    far_m = math.hypot(level_m, z)
    middle_x, middle_y, middle_z = _rolled(sensor.middle_deg, roll_deg)
    level = level_m / far_m
    forward = math.copysign(math.sqrt(max((level - middle_y) * (level + middle_y), 0.0)), middle_x)
    pitch_deg = math.remainder(math.degrees(math.atan2(z / far_m, forward) - math.atan2(middle_z, middle_x)), 360.0)
    if level < abs(middle_y) or abs(pitch_deg) > 90:
        right = "a point that the sensor's middle ray can meet with a pitch between -90 and 90"
        raise InputError(
            f"{place}: aim", f"{sensor.name} cannot be tilted so that its middle ray meets {target}", right
        )
    yaw_deg = math.degrees(math.atan2(y, x) - math.atan2(middle_y, forward))
    return round(math.remainder(yaw_deg, 360.0), _DIGITS) + 0.0, round(pitch_deg, _DIGITS) + 0.0


def _rolled(middle_deg: tuple[float, float], roll_deg: float) -> Spot:
    """The unit vector of the middle ray, turned about x."""
    elevation, azimuth = middle_deg
    x, y, z = cosdg(elevation) * cosdg(azimuth), cosdg(elevation) * sindg(azimuth), sindg(elevation)
    turned = cosdg(roll_deg) * y - sindg(roll_deg) * z, sindg(roll_deg) * y + cosdg(roll_deg) * z
    return float(x), float(turned[0]), float(turned[1])
