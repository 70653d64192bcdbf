r"""Sensors: which way each beam points, how far it reaches; the catalogue.

A sensor is rings, with one elevation and one azimuth offset a ring, an azimuth step and perhaps a field of view; beam
``k`` of ring ``r`` at azimuth index ``a`` is :math:`k = a \cdot channels + r`. Or it is a table of beams, in the order
of its rows (:mod:`pipeline.sensing.beam_tables`). A beam's direction in the sensor's frame (x forward, z up) is

.. math:: (\cos\epsilon \cos\alpha,\; \cos\epsilon \sin\alpha,\; \sin\epsilon)

with elevation :math:`\epsilon` and azimuth :math:`\alpha`, counter-clockwise from the sensor's x axis. The mount turns
it: first roll about x, then pitch (nose up positive), then yaw (counter-clockwise).

Angles stay in degrees until their sine and cosine are taken by functions that are exact at multiples of 90; an azimuth
is rounded to 1e-6 degree first. So a beam at 180 degrees has exactly no y, and does not leave the plane that it lies
in.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import cosdg, sindg

from pipeline.core.errors import InputError
from pipeline.scenario.models import Scenario
from pipeline.scenario.sensors import SensorModel
from pipeline.sensing import beam_tables, catalogue
from pipeline.sensing.beam_tables import BeamTable

_DEFAULT = SensorModel.model_fields


@dataclass(frozen=True)
class Sensor:
    """A LiDAR: rings, all round or in a field of view, or a table of beams; what is not said of its optics is as in
    ``[sensors.<name>]``.

    Attributes
    ----------
    elevations_deg, azimuth_offsets_deg
        One value a ring, in the order of the table.
    azimuths
        Number of azimuths of a ring.
    range_m
        Maximum range.
    source
        Where the table is from.
    wavelength_nm, divergence_mrad
        Of the laser; the full angle at 1/e^2, across and along the elevation, in milliradians. Only effects ask for
        them.
    rated_range_m, rated_reflectivity
        A target of this reflectivity (0 to 1), met squarely, is still noticed at this range. Only effects ask for them.
    range_sigma_m
        Standard deviation of a measured range; only point clouds with traffic ask for it.
    azimuth_deg
        First and last azimuth of a ring; None: all round, from 0.
    table
        Each beam's angles, instead of rings (then there are none).
    assumed
        What is not the maker's.
    """

    name: str
    elevations_deg: tuple[float, ...]
    azimuth_offsets_deg: tuple[float, ...]
    azimuths: int
    range_m: float
    source: str
    wavelength_nm: float = _DEFAULT["wavelength_nm"].default
    divergence_mrad: tuple[float, float] = _DEFAULT["divergence_mrad"].default
    rated_range_m: float | None = _DEFAULT["rated_range_m"].default
    rated_reflectivity: float = _DEFAULT["rated_reflectivity"].default
    range_sigma_m: float = _DEFAULT["range_sigma_m"].default
    azimuth_deg: tuple[float, float] | None = None
    table: BeamTable | None = None
    assumed: str = ""

    @property
    def channels(self) -> int:
        """Number of rings; 0 where a table takes their place."""
        return len(self.elevations_deg)

    @property
    def beams(self) -> int:
        """Number of beams in one turn or frame."""
        return self.channels * self.azimuths if self.table is None else len(self.table)

    @property
    def elevation_span_deg(self) -> tuple[float, float]:
        """The lowest and the highest elevation."""
        angles = self.elevations_deg if self.table is None else self.table.elevation_deg
        return float(min(angles)), float(max(angles))

    @property
    def azimuth_span_deg(self) -> tuple[float, float] | None:
        """Where its field of view begins and ends, counter-clockwise, without the rings' offsets; None: all round."""
        return self.azimuth_deg if self.table is None else self.table.azimuth_span_deg

    @property
    def azimuth_step_deg(self) -> float | None:
        """Between two beams of a ring; None for a table, or a single beam."""
        if self.azimuth_deg is None:
            return 360.0 / self.azimuths if self.azimuths else None
        first, last = self.azimuth_deg
        return (last - first) / (self.azimuths - 1) if self.azimuths > 1 else None

    @property
    def middle_deg(self) -> tuple[float, float]:
        """Elevation and azimuth of the middle ray, which an aim points at something: halfway between the lowest and
        the highest elevation, and between the ends of the field of view; azimuth 0 for a sensor that sees all round."""
        (low, high), span = self.elevation_span_deg, self.azimuth_span_deg
        return 0.5 * (low + high), 0.5 * (span[0] + span[1]) if span is not None else 0.0

    def directions(self, yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> NDArray[np.float64]:
        """Unit vectors of all beams along the world's axes, (beams, 3) float64, for a sensor mounted so."""
        upright = pitch_deg == 0.0 and roll_deg == 0.0
        elevation, azimuth = self._angles_deg(yaw_deg if upright else 0.0)
        flat = cosdg(elevation)
        x, y = flat * cosdg(azimuth), flat * sindg(azimuth)
        z = np.broadcast_to(sindg(elevation), x.shape)
        rays = np.stack([x, y, z], axis=-1).reshape(-1, 3) + 0.0  # + 0.0 turns -0 into 0
        if upright:
            return rays
        matrix = rotation(yaw_deg, pitch_deg, roll_deg)
        # Written out: a BLAS may sum in another order on another machine.
        return rays[:, :1] * matrix[:, 0] + rays[:, 1:2] * matrix[:, 1] + rays[:, 2:] * matrix[:, 2]

    def _angles_deg(self, yaw_deg: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Elevations and azimuths that broadcast to all beams in order, turned by ``yaw_deg``."""
        azimuth: NDArray[np.float64]
        if self.table is not None:
            azimuth = np.mod(self.table.azimuth_deg + yaw_deg, 360.0).round(6)
            return self.table.elevation_deg, azimuth
        if self.azimuth_deg is None:
            steps = np.arange(self.azimuths) * (360.0 / self.azimuths)
        else:
            steps = self.azimuth_deg[0] + np.arange(self.azimuths) * (self.azimuth_step_deg or 0.0)
        offsets = np.asarray(self.azimuth_offsets_deg) + yaw_deg
        azimuth = np.mod(steps[:, None] + offsets[None, :], 360.0).round(6)
        return np.asarray(self.elevations_deg)[None, :], azimuth


def rotation(yaw_deg: float, pitch_deg: float, roll_deg: float) -> NDArray[np.float64]:
    """The matrix R_world_sensor, (3, 3) float64: roll about x, then pitch (nose up positive), then yaw."""
    (cy, sy), (cp, sp), (cr, sr) = ((cosdg(a), sindg(a)) for a in (yaw_deg, pitch_deg, roll_deg))
    yaw = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    pitch = np.array([[cp, 0.0, -sp], [0.0, 1.0, 0.0], [sp, 0.0, cp]])
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    matrix: NDArray[np.float64] = yaw @ pitch @ roll
    return matrix


def _uniform(first: float, last: float, channels: int) -> tuple[float, ...]:
    angles: list[float] = np.round(np.linspace(first, last, channels), 9).tolist()
    return tuple(angles)


class _Catalogue(Mapping[str, Sensor]):
    """The sensors of ``catalogue.toml``, each made when it is first asked for."""

    def __init__(self) -> None:
        self._made: dict[str, Sensor] = {}

    def __getitem__(self, name: str) -> Sensor:
        if name not in self._made:
            entry = catalogue.entries()[name]
            sensor = _made(name, entry, entry.source, Path)
            self._made[name] = replace(sensor, assumed=entry.assumed)
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(catalogue.entries())

    def __len__(self) -> int:
        return len(catalogue.entries())


CATALOGUE: Mapping[str, Sensor] = _Catalogue()
"""The sensors that need no table of the user's. A further one is an entry of ``catalogue.toml``, its number of beams in
``tests/sensing/test_sensors.py``, and a row in ``docs/effects.md`` that says where its rated range is from."""


def of_scenario(name: str, scenario: Scenario, place: str) -> Sensor:
    """The sensor called ``name``, see :func:`resolve`; its beam table is found as the scenario finds files."""
    return resolve(name, scenario.sensors, place, lambda file: scenario.find(file, f"sensors.{name}.beams"))


def resolve(name: str, own: Mapping[str, SensorModel], place: str, find: Callable[[str], Path] = Path) -> Sensor:
    """The sensor called ``name``: the user's own first, then the catalogue's.

    Parameters
    ----------
    find
        Where the beam table of an own sensor is.

    Raises
    ------
    InputError
        Naming the place, and the nearest names that exist; or what is wrong with a beam table.
    """
    if name in own:
        return _made(name, own[name], "the scenario", find)
    if name in CATALOGUE:
        return CATALOGUE[name]
    known = [*own, *CATALOGUE]
    near = difflib.get_close_matches(name, known, 1, 0.4)
    raise InputError(
        place, f"unknown sensor {name!r}", f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
    )


def _made(name: str, model: SensorModel, source: str, find: Callable[[str], Path]) -> Sensor:
    """The sensor that some keys describe."""
    elevations, table = tuple(model.elevations_deg), None
    if model.beams is not None:
        table = beam_tables.read(find(model.beams))
    elif model.pattern is not None:
        table = beam_tables.of_pattern(model.pattern)
    elif model.channels not in (None, len(elevations)):
        elevations = _uniform(elevations[0], elevations[1], model.rings)
    offsets = tuple(model.azimuth_offsets_deg) or (0.0,) * len(elevations)
    return Sensor(
        name, elevations, offsets, model.azimuths, model.range_m, source, azimuth_deg=model.azimuth_deg, table=table,
        **model.optics,
    )  # fmt: skip
