r"""LiDAR sensors: beam directions, range and optics; the catalogue; beam tables.

A sensor is either a set of rings or a table of beams. Rings have one elevation and one azimuth offset each, a common
azimuth step and, optionally, a limited field of view; beam ``k`` of ring ``r`` at azimuth index ``a`` is
:math:`k = a \cdot channels + r`. The beams of a table come in the order of its rows. Both are read from files
(:mod:`egvs.sensors.beam_files`); a table is also computed from a scan pattern (:func:`beams_from_pattern`).

The direction of a beam in the sensor frame (x forward, z up) is

.. math:: (\cos\epsilon \cos\alpha,\; \cos\epsilon \sin\alpha,\; \sin\epsilon)

with elevation :math:`\epsilon` and azimuth :math:`\alpha`, counter-clockwise from the sensor's x axis. The mount
rotates it: first roll about x, then pitch (nose up positive), then yaw (counter-clockwise).

Angles stay in degrees until ``cosdg`` and ``sindg``, which are exact at multiples of 90 degrees, take their cosine and
sine; azimuths are rounded to 1e-6 degree first. A beam at 180 degrees therefore has y = 0 exactly and stays in its
plane.

The catalogue is ``catalogue.toml`` beside this module. An entry has the keys of ``[sensors.<name>]``, its source, and
the values that are assumed because the source does not state them.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from pydantic import Field

from egvs.core import files, limits
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.special import cosdg, sindg
from egvs.scenario.model import Scenario
from egvs.scenario.sensor_config import BeamPatternConfig, SensorConfig
from egvs.sensors.beam_files import BeamTable, read_beam_file, read_directions

FEW_BEAMS = 1000
"""A LiDAR has more beams in a turn or frame; with fewer, a file of rings was probably read as one of single beams."""

_GOLDEN_RATIO = (math.sqrt(5.0) - 1.0) / 2.0
_BEAM_DIGITS = 6


def repeated_beams(table: BeamTable) -> list[tuple[int, int]]:
    """Return (beam, earlier beam) for each beam that repeats the direction of an earlier one, to 1e-6 degree."""
    steps_per_degree = 10**_BEAM_DIGITS
    full_turn = 360 * steps_per_degree
    elevation = np.rint(table.elevation_deg * steps_per_degree).astype(np.int64)
    azimuth = np.rint(table.azimuth_deg * steps_per_degree).astype(np.int64)
    is_vertical = np.abs(elevation) == 90 * steps_per_degree  # there the azimuth does not matter
    direction = elevation * full_turn + np.where(is_vertical, 0, azimuth % full_turn)
    _, first, inverse = np.unique(direction, return_index=True, return_inverse=True)
    earlier = first[inverse]
    repeated = np.flatnonzero(earlier != np.arange(len(table)))
    return [(int(beam), int(earlier[beam])) for beam in repeated]


def describe_few_beams(sensor: Sensor) -> str | None:
    """Return a sentence if a sensor has fewer than :data:`FEW_BEAMS` beams; None otherwise."""
    if sensor.pulses >= FEW_BEAMS:
        return None
    return f"{sensor.name} has {sensor.pulses:,} beams in a turn or frame; a LiDAR has thousands"


def describe_odd_angles(
    name: str, elevations_deg: Sequence[float] | FloatArray, offsets_deg: Sequence[float] = ()
) -> tuple[str, str] | None:
    """Return a problem and a hint if the angles of a sensor look swapped, or as if in radians; None otherwise.

    Azimuth offsets of rings are small; elevations reach over the field of view. A field of view that is narrower than
    pi / 2 degrees has few rings.

    Parameters
    ----------
    name
        The sensor, or its file, for the problem.
    elevations_deg
        Of all rings or beams.
    offsets_deg
        Azimuth offsets of all rings; empty for single beams.
    """
    distinct_deg = np.unique(elevations_deg)
    span_deg = float(np.ptp(distinct_deg))
    if len(distinct_deg) >= MIN_RINGS and span_deg <= MAX_RADIANS and np.abs(distinct_deg).max() <= MAX_RADIANS:
        problem = (
            f"{len(distinct_deg)} elevations of {name} are within {span_deg:.2g} degrees, from"
            f" {distinct_deg[0]:.4g} to {distinct_deg[-1]:.4g}: they look like radians"
        )
        return problem, "Convert them to degrees."
    distinct_offsets_deg = np.unique(offsets_deg)
    if len(offsets_deg) < MIN_RINGS or 2 * len(distinct_offsets_deg) <= len(offsets_deg):
        return None
    offset_span_deg = float(np.ptp(distinct_offsets_deg))
    if offset_span_deg >= max(MIN_SWAPPED_DEG, 2.0 * span_deg) and offset_span_deg <= 180.0:
        problem = (
            f"the azimuth offsets of {name} extend over {offset_span_deg:.3g} degrees, its elevations over"
            f" {span_deg:.3g}: they look swapped"
        )
        return problem, "Swap the names of the two columns or lists, or the columns if they have no names."
    return None


MIN_RINGS = 16
"""With fewer rings, a narrow field of view is usual."""
MAX_RADIANS = math.pi / 2.0
MIN_SWAPPED_DEG = 16.0
"""Azimuth offsets of LiDARs extend over less; 15.6 degrees are the most in the catalogue."""

FEW_BEAMS_HINT = (
    "If each row of its file is a ring, name the column azimuth_offset_deg instead of azimuth_deg and set"
    " azimuth_step_deg; egvs sensors FILE prints what is read."
)


def beams_from_pattern(pattern: BeamPatternConfig, find: Callable[[str], Path] = Path) -> BeamTable:
    r"""Return one frame of a sensor whose scan pattern does not repeat.

    With :math:`n` beams, and :math:`u, v` from 0 to 1 across the field of view in azimuth and elevation:

    - *rosette* (``turns``): two prisms of equal deflection that turn :math:`p` and :math:`q` times in a frame steer the
      beam along :math:`2u - 1 = (\cos 2\pi p t + \cos 2\pi q t) / 2`,
      :math:`2v - 1 = (\sin 2\pi p t + \sin 2\pi q t) / 2`, with :math:`t = (k + 1/2) / n` (a Risley pair at small
      angles: Marshall 1999, Risley prism scan patterns, Proc. SPIE 3787);
    - *even*: :math:`u = (k + 1/2) / n`, :math:`v = frac(1/2 + k (\sqrt 5 - 1) / 2)`, a Kronecker lattice;
    - *file*: the directions of a CSV file, each with the probability that a frame has a pulse there: the number of
      pulses times its share of the dwell time (:func:`egvs.sensors.beam_files.read_directions`). Scores count expected
      hits; a simulated point cloud draws the pulses of its frame.

    Angles of formulas are rounded to 1e-6 degree. ``find`` finds the file.
    """
    if pattern.file is not None:
        return read_directions(find(pattern.file), pattern.samples)
    assert pattern.elevation_deg is not None
    assert pattern.azimuth_deg is not None
    k = np.arange(pattern.samples)
    if pattern.turns is not None:
        first_prism, second_prism = (
            np.mod(360.0 * turns * (k + 0.5) / pattern.samples, 360.0) for turns in pattern.turns
        )
        u = 0.5 + 0.25 * (cosdg(first_prism) + cosdg(second_prism))
        v = 0.5 + 0.25 * (sindg(first_prism) + sindg(second_prism))
    else:
        u = (k + 0.5) / pattern.samples
        v = np.mod(0.5 + k * _GOLDEN_RATIO, 1.0)
    return BeamTable(_interpolate_deg(pattern.elevation_deg, v), _interpolate_deg(pattern.azimuth_deg, u))


def _interpolate_deg(span_deg: tuple[float, float], share: FloatArray) -> FloatArray:
    low, high = span_deg
    return np.round(low + (high - low) * share, _BEAM_DIGITS)


_DEFAULTS = SensorConfig.model_fields


@dataclass(frozen=True)
class Sensor:
    """A LiDAR: rings over the full circle or a field of view, or a table of beams.

    Defaults of the optics are those of ``[sensors.<name>]``.

    Attributes
    ----------
    elevations_deg, azimuth_offsets_deg
        One value per ring, in the order of the table.
    azimuths
        Number of azimuths of a ring.
    range_m
        Maximum range.
    source
        Document that the values are from.
    wavelength_nm
        Wavelength of the laser. Used by effects only.
    divergence_mrad
        Full divergence angle at 1/e^2, across and along the elevation, in milliradians. Used by effects only.
    rated_range_m, rated_reflectivity
        A target of this reflectivity (0 to 1) is still detected at this range at normal incidence.
    softness, dropout
        Losses of returns from vehicles, see :mod:`egvs.sensors.return_model`.
    range_sigma_m
        Standard deviation of a measured range. Used only by point clouds with traffic.
    azimuth_deg
        First and last azimuth of a ring; None for the full circle, from 0.
    table
        Angles of each beam, instead of rings (there are none then).
    assumed
        Which values are assumed, not the maker's.
    rated_source
        Document that the rated range is from, and what is assumed of it; empty for a user's sensor.
    """

    name: str
    elevations_deg: tuple[float, ...]
    azimuth_offsets_deg: tuple[float, ...]
    azimuths: int
    range_m: float
    source: str
    wavelength_nm: float = _DEFAULTS["wavelength_nm"].default
    divergence_mrad: tuple[float, float] = _DEFAULTS["divergence_mrad"].default
    rated_range_m: float | None = _DEFAULTS["rated_range_m"].default
    rated_reflectivity: float = _DEFAULTS["rated_reflectivity"].default
    softness: float = _DEFAULTS["softness"].default
    dropout: float = _DEFAULTS["dropout"].default
    range_sigma_m: float = _DEFAULTS["range_sigma_m"].default
    azimuth_deg: tuple[float, float] | None = None
    table: BeamTable | None = None
    assumed: str = ""
    rated_source: str = ""

    @property
    def channels(self) -> int:
        """Number of rings; 0 for a sensor with a beam table."""
        return len(self.elevations_deg)

    @property
    def beams(self) -> int:
        """Number of beams of one turn or frame."""
        if self.table is not None:
            return len(self.table)
        return self.channels * self.azimuths

    @property
    def beam_weight(self) -> FloatArray | None:
        """Probability that a frame has each beam, (beams,) float64; None if each frame has all."""
        return None if self.table is None else self.table.weight

    @property
    def pulses(self) -> int:
        """Number of pulses of one turn or frame; of a sensor with dwell times fewer than its beams."""
        return self.beams if self.beam_weight is None else round(float(self.beam_weight.sum()))

    @property
    def elevation_span_deg(self) -> tuple[float, float]:
        """Lowest and highest elevation."""
        if self.table is not None:
            return float(min(self.table.elevation_deg)), float(max(self.table.elevation_deg))
        return float(min(self.elevations_deg)), float(max(self.elevations_deg))

    @property
    def azimuth_span_deg(self) -> tuple[float, float] | None:
        """Ends of the field of view, counter-clockwise, without the rings' offsets; None for the full circle."""
        if self.table is not None:
            return self.table.azimuth_span_deg
        return self.azimuth_deg

    @property
    def azimuth_step_deg(self) -> float | None:
        """Angle between two beams of a ring; None for a table, or a single beam."""
        if self.azimuth_deg is None:
            return 360.0 / self.azimuths if self.azimuths else None
        if self.azimuths <= 1:
            return None
        first, last = self.azimuth_deg
        return (last - first) / (self.azimuths - 1)

    @property
    def middle_deg(self) -> tuple[float, float]:
        """Elevation and azimuth of the middle ray, the ray that an aim points at its target.

        It lies halfway between the lowest and the highest elevation, and between the ends of the field of view; its
        azimuth is 0 for a sensor with a full circle.
        """
        low, high = self.elevation_span_deg
        azimuth_deg = 0.0
        if self.azimuth_span_deg is not None:
            azimuth_deg = 0.5 * (self.azimuth_span_deg[0] + self.azimuth_span_deg[1])
        return 0.5 * (low + high), azimuth_deg

    def directions(self, yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> FloatArray:
        """Return the unit vectors of all beams along the world axes, (beams, 3) float64, for a mounted sensor."""
        is_upright = pitch_deg == 0.0 and roll_deg == 0.0
        elevation, azimuth = self._angles_deg(yaw_deg if is_upright else 0.0)
        flat = cosdg(elevation)
        x = flat * cosdg(azimuth)
        y = flat * sindg(azimuth)
        z = np.broadcast_to(sindg(elevation), x.shape)
        rays = np.stack([x, y, z], axis=-1).reshape(-1, 3) + 0.0  # + 0.0 turns -0 into 0
        if is_upright:
            return rays
        matrix = rotation_world_sensor(yaw_deg, pitch_deg, roll_deg)
        # Written out: a BLAS may sum in another order on another machine.
        return rays[:, :1] * matrix[:, 0] + rays[:, 1:2] * matrix[:, 1] + rays[:, 2:] * matrix[:, 2]

    @property
    def beam_table(self) -> BeamTable:
        """All beams in order, as a table."""
        elevation, azimuth = np.broadcast_arrays(*self._angles_deg(0.0))
        return BeamTable(elevation.ravel(), azimuth.ravel())

    def _angles_deg(self, yaw_deg: float) -> tuple[FloatArray, FloatArray]:
        """Elevations and azimuths that broadcast to all beams in order, turned by ``yaw_deg``."""
        azimuth: FloatArray
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


def rotation_world_sensor(yaw_deg: float, pitch_deg: float, roll_deg: float) -> FloatArray:
    """Return the matrix R_world_sensor, (3, 3) float64: roll about x, then pitch (nose up positive), then yaw."""
    cy, sy = cosdg(yaw_deg), sindg(yaw_deg)
    cp, sp = cosdg(pitch_deg), sindg(pitch_deg)
    cr, sr = cosdg(roll_deg), sindg(roll_deg)
    yaw = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    pitch = np.array([[cp, 0.0, -sp], [0.0, 1.0, 0.0], [sp, 0.0, cp]])
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    matrix: FloatArray = yaw @ pitch @ roll
    return matrix


CATALOGUE_FILE = Path(__file__).with_name("catalogue.toml")


class CatalogueEntry(SensorConfig):
    """A sensor of the catalogue."""

    source: str = Field(min_length=1, description="The maker's document, or another source of the values")
    assumed: str = Field("", description="Which values the source does not state")
    rated_source: str = Field("", description="Where the rated range is from, and what is assumed of it")


@cache
def catalogue_entries() -> dict[str, CatalogueEntry]:
    """Return all entries by name, in the order of the file."""
    with CATALOGUE_FILE.open("rb") as file:
        document = tomllib.load(file)
    return {name: CatalogueEntry.from_dict(values) for name, values in document.items()}


def catalogue_digest(name: str) -> str:
    """Return the hash of an entry's beams and optics; the range noise is left out, since empty scans have none."""
    entry = catalogue_entries()[name]
    left_out = {"source", "assumed", "rated_source", "range_sigma_m"}
    return files.hash_json(entry.model_dump(mode="json", exclude=left_out))


class _Catalogue(Mapping[str, Sensor]):
    """The sensors of ``catalogue.toml``, each made at its first use."""

    def __init__(self) -> None:
        self._sensors: dict[str, Sensor] = {}

    def __getitem__(self, name: str) -> Sensor:
        if name not in self._sensors:
            entry = catalogue_entries()[name]
            sensor = _sensor_from_config(name, entry, entry.source, Path)
            self._sensors[name] = replace(sensor, assumed=entry.assumed, rated_source=entry.rated_source)
        return self._sensors[name]

    def __iter__(self) -> Iterator[str]:
        return iter(catalogue_entries())

    def __len__(self) -> int:
        return len(catalogue_entries())


CATALOGUE: Mapping[str, Sensor] = _Catalogue()
"""The built-in sensors. A new one needs an entry in ``catalogue.toml``, its number of beams in
``tests/sensors/test_sensor.py``, and a row in ``docs/data/rated_ranges.csv``."""


def scenario_sensor(name: str, scenario: Scenario, where: str) -> Sensor:
    """Return the sensor called ``name``, see :func:`resolve_sensor`; beam tables are relative to the scenario.

    Messages name the key of ``[sites]`` that sets this sensor, if there is one, in place of ``where``.
    """
    where = _sites_key(name, scenario) or where
    config = scenario.sensors.get(name)
    key = config.beam_file[0] if config is not None and config.beam_file is not None else "beams"
    return resolve_sensor(name, scenario.sensors, where, lambda file: scenario.find(file, f"sensors.{name}.{key}"))


def _sites_key(name: str, scenario: Scenario) -> str:
    """Return file and key of ``[sites]`` that set a sensor; empty if only rows of the sites file do."""
    for key in ("replace_sensor", "sensor"):
        value = getattr(scenario.sites, key)
        if name == value or (isinstance(value, tuple) and name in value):
            file = "--set" if f"sites.{key}" in scenario.overrides else scenario.file
            return f"{file}: sites.{key}"
    return ""


def resolve_sensor(
    name: str, custom: Mapping[str, SensorConfig], where: str, find: Callable[[str], Path] = Path
) -> Sensor:
    """Return the sensor called ``name``: a user's ``[sensors.<name>]`` takes precedence over the catalogue.

    Parameters
    ----------
    name
        Name of the sensor.
    custom
        The user's sensors, by name.
    where
        File and key, for messages.
    find
        Finds the file of a custom sensor's beam table.

    Raises
    ------
    InputError
        When there is no such sensor, with the nearest name that exists; or when a beam table is invalid.
    """
    if name in custom:
        return _sensor_from_config(name, custom[name], "the scenario", find)
    if name in CATALOGUE:
        return CATALOGUE[name]
    raise _unknown_sensor(name, custom, where)


def check_sensor_names(names: Iterable[str], custom: Iterable[str], where: str) -> None:
    """Check that names are those of sensors.

    Parameters
    ----------
    names
        The names.
    custom
        Names of sensors that are known besides those of the catalogue.
    where
        File and key, for messages.

    Raises
    ------
    InputError
        For an unknown name, with the nearest one that exists.
    """
    custom = tuple(custom)
    for name in names:
        if name not in custom and name not in CATALOGUE:
            raise _unknown_sensor(name, custom, where)


def _unknown_sensor(name: str, custom: Iterable[str], where: str) -> InputError:
    """Return the error for an unknown sensor, with the nearest name that exists."""
    known = [*custom, *CATALOGUE]
    similar = difflib.get_close_matches(name, known, 1, 0.4)
    hint = f"Known sensors are {', '.join(known)}."
    if similar:
        hint = f"Did you mean {similar[0]}? egvs sensors lists them."
    return InputError(where, f"unknown sensor {name!r}", hint)


def _sensor_from_file(name: str, config: SensorConfig, source: str, path: Path) -> Sensor:
    """Return a sensor whose beams a file states; its columns are those of the file or, if it has none, the user's."""
    beams = read_beam_file(path).beams
    where = f"sensors.{name}"
    keys = [key for key in ("azimuth_step_deg", "azimuth_deg") if getattr(config, key) is not None]
    if isinstance(beams, BeamTable):
        if read_beam_file(path).dwell_s is not None:
            problem = f"{path.name} has dwell times, which count only in a pattern"
            hint = f'Use [sensors.{name}.pattern] with kind = "file", file = "{path.name}", samples = PULSES.'
            raise InputError(f"{where}.beams", problem, hint)
        if keys:
            problem = f"no effect with {path.name}, which lists single beams"
            raise InputError(f"{where}.{keys[0]}", problem, "Omit it, or give a file with a row per ring.")
        return Sensor(name, (), (), 0, config.range_m, source, table=beams, **config.optics)
    azimuths, azimuth_deg = beams.azimuths, beams.azimuth_deg
    if azimuths is not None and keys:
        problem = f"no effect with {path.name}, which states {azimuths:,} columns"
        raise InputError(f"{where}.{keys[0]}", problem, "Omit it.")
    if azimuths is None:
        if config.azimuth_step_deg is None:
            problem = f"expected azimuth_step_deg, since {path.name} lists {len(beams.elevations_deg)} rings, got none"
            raise InputError(where, problem, "Give the angle between neighbouring beams of a ring.")
        azimuths, azimuth_deg = config.azimuths, config.azimuth_deg
        limits.BEAMS.check(where, azimuths * len(beams.elevations_deg))
    return Sensor(
        name,
        beams.elevations_deg,
        beams.azimuth_offsets_deg,
        azimuths,
        config.range_m,
        source,
        azimuth_deg=azimuth_deg,
        **config.optics,
    )


def _sensor_from_config(name: str, config: SensorConfig, source: str, find: Callable[[str], Path]) -> Sensor:
    elevations = tuple(config.elevations_deg)
    table = None
    if config.beams is not None:
        return _sensor_from_file(name, config, source, find(config.beams))
    if config.pattern is not None:
        table = beams_from_pattern(config.pattern, find)
    elif config.channels not in (None, len(elevations)):
        first, last = elevations
        elevations = tuple(np.round(np.linspace(first, last, config.rings), 9).tolist())
    return Sensor(
        name=name,
        elevations_deg=elevations,
        azimuth_offsets_deg=tuple(config.azimuth_offsets_deg) or (0.0,) * len(elevations),
        azimuths=config.azimuths,
        range_m=config.range_m,
        source=source,
        azimuth_deg=config.azimuth_deg,
        table=table,
        **config.optics,
    )
