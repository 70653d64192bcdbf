r"""Losses of returns: the probability that a sensor detects the return of a pulse that meets a road user.

.. math:: P(r) = (1 - d)\, \Phi\!\left( \frac{2 \ln(r_{max} / r)}{s} \right), \qquad
          r_{max} = r_0 \sqrt{\frac{\rho \cos\theta}{\rho_0}}

:math:`r_0` is the sensor's rated range for a target of reflectivity :math:`\rho_0` (data sheet), :math:`s` its softness
and :math:`d` its dropout; :math:`\rho` is the reflectivity of the target. The power of a return from a diffuse surface
that is larger than the beam's footprint is proportional to :math:`\rho \cos\theta / r^2` (Höfle and Pfeifer 2007, ISPRS
J. Photogramm. Remote Sens. 62(6), 415-433); its logarithm is assumed to be normally distributed about that, as a sum of
many terms: paint, incidence, gloss, alignment, gain. :math:`\Phi` is the normal distribution. The fitted reflectivity
of road users contains the incidence at which pulses meet them, so their :math:`\theta` is 0 unless a scenario sets it.

**Where the defaults are from.** One setting, :math:`\rho = 0.03`, :math:`s = 1`, :math:`d = 0.05`, with the rated
ranges of the data sheets (55 m and 200 m at 10 %), makes the simulated points on cars 0.92 and 1.08 times the measured
ones of two units, an Ouster OS1-64 and a Hesai Pandar64; without losses they are 2.96 and 1.15 times as many. It was
fitted on these two units, at one junction each, so the agreement is no test of it. Apart from each other, they give
:math:`\rho` of 0.030 and 0.052, and :math:`s` of 1.0 and 2.2. A reflectivity of 0.03 is that of a pulse on average:
bodies of cars are glossy and mostly inclined, and much of the light leaves as from a mirror.

**When losses are simulated.** If, for any sensor, more than :data:`NEGLIGIBLE_LOSS` of the returns are lost by range at
the point of the region that is farthest from a site of it, and within its range, losses of all sensors are simulated
(:func:`decide_losses`). Otherwise neither the loss by range nor the dropout is.

Reflectivities of classes of road users, with their sources, are in ``reflectivity.toml`` beside this module.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, Roi
from egvs.core.special import cosdg, ndtr
from egvs.core.wording import format_percent
from egvs.scenario.effects_config import RangeLimitParameters
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Site

REFLECTIVITY_FILE = Path(__file__).with_name("reflectivity.toml")

CAR = "car"
"""The class whose reflectivity was fitted, and that of targets of no known class."""

REFLECTIVITY_INTERVAL = (0.03, 0.06)
"""Assumed interval of the default. Two units give 0.030 and 0.052, the second with a standard error of 0.026."""

GLASS_RATIO = 0.75
"""Reflectivity of windows over that of the whole vehicle: the OS1-64 loses 71 % of the pulses that meet windows of cars
and 61 % of all that meet cars, which is 0.28 standard deviations of the logarithm of power; exp(-0.28 s), s = 1.

This is one unit. Of cars, it makes windows 0.68 times the rest of the body; the losses of an 80-beam unit on bright
paint and windows (5 and 21 %, ``docs/validity.md``) imply about 0.43."""

NEGLIGIBLE_LOSS = 0.05
"""Losses by range are simulated if they are larger than this anywhere in the region; the fit leaves 0.1."""

_NEGLIGIBLE_LOSS_SIGMAS = 1.6448536269514722
"""The normal distribution is 1 - ``NEGLIGIBLE_LOSS`` here."""


@dataclass(frozen=True)
class RoadUserClass:
    """What a class of road users reflects; an entry of ``reflectivity.toml``.

    Attributes
    ----------
    name
        Name of the class.
    reflectivity
        Median over all pulses that meet it, windows included.
    interval
        Assumed interval.
    glass_share
        Share of its silhouette that is windows.
    source
        The evidence.
    vclasses
        SUMO's vClasses that belong to it.
    """

    name: str
    reflectivity: float
    interval: tuple[float, float]
    glass_share: float
    source: str
    vclasses: tuple[str, ...]

    @property
    def glass_reflectivity(self) -> float:
        """Reflectivity of its windows."""
        return self.reflectivity * GLASS_RATIO

    @property
    def body_reflectivity(self) -> float:
        """Reflectivity of the rest: the geometric mean with that of windows, by their shares, is ``reflectivity``."""
        return float(self.reflectivity * GLASS_RATIO ** (-self.glass_share / (1.0 - self.glass_share)))


@cache
def road_user_classes() -> Mapping[str, RoadUserClass]:
    """Return the classes of road users by name."""
    with REFLECTIVITY_FILE.open("rb") as file:
        document = tomllib.load(file)
    return {name: _road_user_class(name, entry) for name, entry in document.items()}


def _road_user_class(name: str, entry: dict[str, Any]) -> RoadUserClass:
    low, high = entry["interval"]
    return RoadUserClass(
        name, entry["reflectivity"], (low, high), entry["glass_share"], entry["source"], tuple(entry["vclasses"])
    )


@cache
def class_of(vclass: str) -> RoadUserClass:
    """Return the class that a SUMO vClass belongs to; that of cars for one that is not listed."""
    for road_users in road_user_classes().values():
        if vclass in road_users.vclasses:
            return road_users
    return road_user_classes()[CAR]


@dataclass(frozen=True)
class ReturnModel:
    """The losses of one sensor.

    Attributes
    ----------
    rated_range_m, rated_reflectivity
        A target of this reflectivity, at normal incidence, is detected at this range with a probability of 1/2, apart
        from dropout.
    softness
        Standard deviation of the logarithm of the received power; 0 is a hard limit.
    dropout
        Share of the returns that are lost at any range.
    reflectivity
        Reflectivity of all road users; None for that of each class.
    incidence_deg
        Angle between the beam and the normal of road users, in addition to what their reflectivity contains.

    Examples
    --------
    >>> model = ReturnModel(rated_range_m=55.0, rated_reflectivity=0.1)
    >>> round(model.limit_m(0.03), 1)
    30.1
    >>> model.probability(np.array([0.0, model.limit_m(0.03), 60.0])).round(3).tolist()
    [0.95, 0.475, 0.08]
    """

    rated_range_m: float
    rated_reflectivity: float
    softness: float = 1.0
    dropout: float = 0.05
    reflectivity: float | None = None
    incidence_deg: float = 0.0

    @classmethod
    def of(cls, sensor: Sensor, parameters: RangeLimitParameters | None = None) -> ReturnModel:
        """Return the losses of a sensor, with the values that ``[effects.range_limit]`` replaces.

        Raises
        ------
        InputError
            When neither the sensor nor the parameters state a rated range.
        """
        config = RangeLimitParameters() if parameters is None else parameters
        range_m = config.rated_range_m or sensor.rated_range_m
        if range_m is None:
            where = f"effects.range_limit: sensor {sensor.name}"
            hint = f"Add it to [sensors.{sensor.name}], or to [effects.range_limit]."
            raise InputError(where, "rated_range_m is missing", hint)
        return cls(
            rated_range_m=range_m,
            rated_reflectivity=config.rated_reflectivity or sensor.rated_reflectivity,
            softness=sensor.softness if config.softness is None else config.softness,
            dropout=sensor.dropout if config.dropout is None else config.dropout,
            reflectivity=config.reflectivity,
            incidence_deg=config.incidence_deg,
        )

    def target_reflectivity(self, vclass: str | None = None) -> float:
        """Return the reflectivity of a road user of a SUMO vClass, by default a car, times the cosine of incidence."""
        if self.reflectivity is not None:
            return self.reflectivity * self._cosine
        return self._cosine * (road_user_classes()[CAR] if vclass is None else class_of(vclass)).reflectivity

    def surface_reflectivity(self, reflectivity: FloatArray, of_class: FloatArray | None = None) -> FloatArray:
        """Return the reflectivity of surfaces as the scenario sets that of road users, (n,) float64.

        Parameters
        ----------
        reflectivity
            Reflectivity of each surface without what the scenario sets, (n,) float64.
        of_class
            Reflectivity of the class of its road user, (n,) float64: parts, such as windows, keep their ratio to it.
            NaN for the static world, which stays as it is; by default, surfaces are whole road users.
        """
        if of_class is None:
            of_class = reflectivity
        changed = reflectivity * self._cosine
        if self.reflectivity is not None:
            changed = self.reflectivity * self._cosine * (reflectivity / of_class)
        return np.where(np.isnan(of_class), reflectivity, changed)

    @property
    def _cosine(self) -> float:
        return float(cosdg(self.incidence_deg)) if self.incidence_deg else 1.0

    def limit_m(self, reflectivity: float) -> float:
        """Return the range at which a target is detected with a probability of 1/2, apart from dropout, metres."""
        return self.rated_range_m * math.sqrt(reflectivity / self.rated_reflectivity)

    def probability(self, range_m: FloatArray, reflectivity: float | FloatArray | None = None) -> FloatArray:
        """Return the probability that a return is detected, (n,) float64, 0 to 1.

        Parameters
        ----------
        range_m
            Range of each target, (n,) float64.
        reflectivity
            Reflectivity of all targets or of each, (n,) float64; by default that of :meth:`target_reflectivity`.
        """
        rho = self.target_reflectivity() if reflectivity is None else reflectivity
        limit_m = self.limit_m(1.0) * np.sqrt(rho)
        if self.softness == 0:
            return (1.0 - self.dropout) * (range_m <= limit_m).astype(np.float64)
        with np.errstate(divide="ignore", over="ignore"):  # the power is infinite at the sensor itself
            detected: FloatArray = ndtr(2.0 * np.log(limit_m / range_m) / self.softness)
        return (1.0 - self.dropout) * detected

    @property
    def lossless_range_m(self) -> float:
        """Range up to which at most :data:`NEGLIGIBLE_LOSS` of the returns from a car are lost by range, metres."""
        sigmas = _NEGLIGIBLE_LOSS_SIGMAS * self.softness
        return self.limit_m(self.target_reflectivity()) * math.exp(-0.5 * sigmas)


@dataclass(frozen=True)
class LossDecision:
    """Whether losses of returns can change the result, by sensor; see :func:`decide_losses`.

    Attributes
    ----------
    acting
        Sensors with losses, by name: the farthest point of the region in reach, and the range up to which losses are
        negligible, metres. Those of one that does not need them act if those of another do, so that all have the same.
    negligible
        The same where no sensor needs losses.
    unrated
        Sensors without a rated range.
    """

    acting: Mapping[str, tuple[float, float]]
    negligible: Mapping[str, tuple[float, float]]
    unrated: tuple[str, ...]

    def to_json(self) -> dict[str, list[str]]:
        """Return the names of the sensors by decision, for the summary of a stage."""
        return {"on": list(self.acting), "negligible": list(self.negligible), "unrated": list(self.unrated)}

    @property
    def negligible_note(self) -> str:
        """Why sensors have no losses."""
        share = format_percent(NEGLIGIBLE_LOSS, 0)
        return f"not called for: {', '.join(self.negligible)} lose at most {share} of returns from the region"

    @property
    def notes(self) -> tuple[str, ...]:
        """What was decided: lines for sensors with losses, and for each without a rated range."""
        notes = []
        if self.acting:
            needing = {name: values for name, values in self.acting.items() if values[0] > values[1]}
            reach_m = max(reach for reach, _ in needing.values())
            listed = ", ".join(f"{name} ({limit:.0f} m)" for name, (_, limit) in needing.items())
            notes.append(
                f"losses of returns are simulated for {listed}: the region reaches to {reach_m:.0f} m, farther than "
                f"the range in brackets, where {format_percent(NEGLIGIBLE_LOSS, 0)} are lost (effects.range_limit = "
                "false: off)"
            )
            if others := [name for name in self.acting if name not in needing]:
                notes.append(f"losses of returns are simulated for {', '.join(others)}, too: for all sensors or none")
        for name in self.unrated:
            notes.append(
                f"losses of returns are not simulated for {name}, which has no rated range: every return is assumed to "
                f"be detected. Enter rated_range_m and rated_reflectivity under [sensors.{name}]"
            )
        return tuple(notes)


def decide_losses(sites: Iterable[Site], sensors: Mapping[str, Sensor], roi: Roi) -> LossDecision:
    """Decide by rated ranges and distances in the region whether sensors need losses of returns.

    If any needs them, all with a rated range have them: a sensor that loses nothing would gain on the others by its
    dropout.

    Parameters
    ----------
    sites
        Candidate sites.
    sensors
        Their sensors by name.
    roi
        The region of interest.
    """
    low, size = np.asarray(roi.origin_m), np.asarray(roi.size_m)
    reach_m: dict[str, float] = {}
    for site in sites:
        position = np.asarray(site.pose.position_m)
        farthest = np.maximum(np.abs(position - low), np.abs(position - low - size))
        reach_m[site.sensor] = max(reach_m.get(site.sensor, 0.0), math.sqrt(float((farthest**2).sum())))

    rated: dict[str, tuple[float, float]] = {}
    unrated = []
    for name, distance_m in reach_m.items():
        sensor = sensors[name]
        if sensor.rated_range_m is None:
            unrated.append(name)
            continue
        limit_m = ReturnModel.of(sensor).lossless_range_m
        rated[name] = min(distance_m, sensor.range_m), limit_m
    if any(reach_m > limit_m for reach_m, limit_m in rated.values()):
        return LossDecision(rated, {}, tuple(unrated))
    return LossDecision({}, rated, tuple(unrated))
