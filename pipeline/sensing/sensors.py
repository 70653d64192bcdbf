r"""Sensors: which way each beam points, how far it reaches; the catalogue.

A sensor is a table: one elevation and one azimuth offset a ring, an azimuth step, a maximum range. Beam ``k`` of ring
``r`` at azimuth index ``a`` is :math:`k = a \cdot channels + r`. Its direction in the sensor's frame (x forward, z up)
is

.. math:: (\cos\epsilon \cos\alpha,\; \cos\epsilon \sin\alpha,\; \sin\epsilon)

with elevation :math:`\epsilon` and azimuth :math:`\alpha`, counter-clockwise from the sensor's x axis. The mount turns
it: first roll about x, then pitch (nose up positive), then yaw (counter-clockwise).

Angles stay in degrees until their sine and cosine are taken by functions that are exact at multiples of 90; an azimuth
is rounded to 1e-6 degree first. So a beam at 180 degrees has exactly no y, and does not leave the plane that it lies
in.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import cosdg, sindg

from pipeline.core.errors import InputError
from pipeline.scenario.sensors import SensorModel

_DEFAULT = SensorModel.model_fields


@dataclass(frozen=True)
class Sensor:
    """A spinning LiDAR; what is not said of its optics is as in ``[sensors.<name>]``.

    Attributes
    ----------
    elevations_deg, azimuth_offsets_deg
        One value a ring, in the order of the table.
    azimuths
        Number of azimuth steps a turn.
    range_m
        Maximum range.
    source
        Where the table is from.
    wavelength_nm, divergence_mrad
        Of the laser; the full angle at 1/e^2, across and along the elevation, in milliradians. Only effects ask for
        them.
    rated_range_m, rated_reflectivity
        A target of this reflectivity (0 to 1), met squarely, is still noticed at this range. Only effects ask for them.
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

    @property
    def channels(self) -> int:
        """Number of rings."""
        return len(self.elevations_deg)

    @property
    def beams(self) -> int:
        """Number of beams in one turn."""
        return self.channels * self.azimuths

    @property
    def middle_deg(self) -> tuple[float, float]:
        """Elevation and azimuth of the middle ray, which an aim points at something: halfway between the lowest and
        the highest elevation; the azimuth of a sensor that sees all round is 0."""
        return 0.5 * (min(self.elevations_deg) + max(self.elevations_deg)), 0.0

    def directions(self, yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> NDArray[np.float64]:
        """Unit vectors of all beams along the world's axes, (beams, 3) float64, for a sensor mounted so."""
        steps = np.arange(self.azimuths) * (360.0 / self.azimuths)
        upright = pitch_deg == 0.0 and roll_deg == 0.0
        offsets = np.asarray(self.azimuth_offsets_deg) + (yaw_deg if upright else 0.0)
        azimuth = np.round(np.mod(steps[:, None] + offsets[None, :], 360.0), 6)
        elevation = np.asarray(self.elevations_deg)[None, :]
        flat = cosdg(elevation)
        x, y = flat * cosdg(azimuth), flat * sindg(azimuth)
        z = np.broadcast_to(sindg(elevation), x.shape)
        rays = np.stack([x, y, z], axis=-1).reshape(-1, 3) + 0.0  # + 0.0 turns -0 into 0
        if upright:
            return rays
        matrix = rotation(yaw_deg, pitch_deg, roll_deg)
        # Written out: a BLAS may sum in another order on another machine.
        return rays[:, :1] * matrix[:, 0] + rays[:, 1:2] * matrix[:, 1] + rays[:, 2:] * matrix[:, 2]


def rotation(yaw_deg: float, pitch_deg: float, roll_deg: float) -> NDArray[np.float64]:
    """The matrix R_world_sensor, (3, 3) float64: roll about x, then pitch (nose up positive), then yaw."""
    (cy, sy), (cp, sp), (cr, sr) = ((cosdg(a), sindg(a)) for a in (yaw_deg, pitch_deg, roll_deg))
    yaw = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    pitch = np.array([[cp, 0.0, -sp], [0.0, 1.0, 0.0], [sp, 0.0, cp]])
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    matrix: NDArray[np.float64] = yaw @ pitch @ roll
    return matrix


# Elevation and azimuth offset of the VLP-32C in firing order.
_VLP_32C = (
    (-25, 1.4), (-1, -4.2), (-1.667, 1.4), (-15.639, -1.4), (-11.31, 1.4), (0, -1.4), (-0.667, 4.2), (-8.843, -1.4),
    (-7.254, 1.4), (0.333, -4.2), (-0.333, 1.4), (-6.148, -1.4), (-5.333, 4.2), (1.333, -1.4), (0.667, 4.2), (-4, -1.4),
    (-4.667, 1.4), (1.667, -4.2), (1, 1.4), (-3.667, -4.2), (-3.333, 4.2), (3.333, -1.4), (2.333, 1.4), (-2.667, -1.4),
    (-3, 1.4), (7, -1.4), (4.667, 1.4), (-2.333, -4.2), (-2, 4.2), (15, -1.4), (10.333, 1.4), (-1.333, -1.4),
)  # fmt: skip


def _uniform(first: float, last: float, channels: int) -> tuple[float, ...]:
    return tuple(float(np.round(e, 9)) for e in np.linspace(first, last, channels))


def _plain(
    name: str, elevations: tuple[float, ...], azimuths: int, range_m: float, source: str, **optics: Any
) -> Sensor:
    return Sensor(name, elevations, (0.0,) * len(elevations), azimuths, range_m, source, **optics)


# Velodyne's VLP-16 and VLP-32C: 903 nm; a range "up to" 100 m or 200 m, of no stated reflectivity. Assumed: 0.8, at
# which the maker rates its HDL-64E (120 m; 50 m at 0.1); and the divergence that it states for its VLS-128 (user manual
# 63-9483), 3.0 mrad across and 1.5 mrad along the elevation.
_VELODYNE: dict[str, Any] = {"wavelength_nm": 903.0, "divergence_mrad": (3.0, 1.5), "rated_reflectivity": 0.8}

# Hesai PandarXT-32: 905 nm, 80 m at 10 %, of no stated chance. The outer rings may reach less far, as they do in the
# PandarXT-16 (user manual: 80 m within 7 degrees of level, 50 m beyond). Its divergence is assumed: the default.
_XT_32: dict[str, Any] = {"wavelength_nm": 905.0, "rated_range_m": 80.0, "rated_reflectivity": 0.1}

# Ouster OS1 datasheet, revision 6: 865 nm; at 1024 columns and 10 Hz, 10 % reflectivity and 100 klx, 55 m at a chance
# above 50 % (45 m above 90 %). At 80 % it says 120 m (100 m); the power law says 156 m. Divergence: 0.18 deg at half
# maximum (an earlier datasheet, of the field of view of 45 deg), which is 1.70 times as wide at 1/e^2: 5.34 mrad. Left
# out: the beams' azimuth offsets, about 1.4 and 4.2 deg to either side.
_OS1: dict[str, Any] = {
    "wavelength_nm": 865.0,
    "divergence_mrad": (5.34, 5.34),
    "rated_range_m": 55.0,
    "rated_reflectivity": 0.1,
}

CATALOGUE: Mapping[str, Sensor] = {
    s.name: s
    for s in (
        _plain(
            "VLP-16", tuple(float(e) for pair in zip(range(-15, 0, 2), range(1, 16, 2), strict=True) for e in pair),
            1800, 100.0, "Velodyne VLP-16 User Manual 63-9243, laser angles in firing order; 0.2 deg at 10 Hz",
            rated_range_m=100.0, **_VELODYNE,
        ),
        Sensor(
            "VLP-32C", tuple(float(e) for e, _ in _VLP_32C), tuple(a for _, a in _VLP_32C),
            1800, 200.0, "Velodyne VLP-32C User Manual 63-9325, firing order; 0.2 deg at 10 Hz",
            rated_range_m=200.0, **_VELODYNE,
        ),
        _plain(
            "Pandar XT-32", _uniform(15, -16, 32),
            2000, 120.0, "Hesai PandarXT-32 User Manual, design values, 1 deg apart; 0.18 deg at 10 Hz", **_XT_32,
        ),
        _plain(
            "OS1-64", _uniform(22.5, -22.5, 64),
            1024, 120.0, "Ouster OS1 datasheet (gen 2), 45 deg uniform, 1024 columns", **_OS1,
        ),
        _plain(
            "OS1-128", _uniform(22.5, -22.5, 128),
            1024, 120.0, "Ouster OS1 datasheet (gen 2), 45 deg uniform, 1024 columns", **_OS1,
        ),
    )
}  # fmt: skip
"""The sensors that need no table of the user's; elevations are the makers' design values. A further one is an entry
here, its number of beams in ``tests/sensing/test_sensors.py``, and a row in ``docs/effects.md`` that says where its
rated range is from."""


def resolve(name: str, own: Mapping[str, SensorModel], place: str) -> Sensor:
    """The sensor called ``name``: the user's own first, then the catalogue's.

    Raises
    ------
    InputError
        Naming the place, and the nearest names that exist.
    """
    if name in own:
        model = own[name]
        elevations = tuple(model.elevations_deg)
        if model.channels not in (None, len(elevations)):
            elevations = _uniform(elevations[0], elevations[1], model.channels or 0)
        offsets = tuple(model.azimuth_offsets_deg) or (0.0,) * len(elevations)
        return Sensor(
            name,
            elevations,
            offsets,
            round(360.0 / model.azimuth_step_deg),
            model.range_m,
            "the scenario",
            **model.optics,
        )
    if name in CATALOGUE:
        return CATALOGUE[name]
    known = [*own, *CATALOGUE]
    near = difflib.get_close_matches(name, known, 1, 0.4)
    raise InputError(
        place, f"unknown sensor {name!r}", f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
    )
