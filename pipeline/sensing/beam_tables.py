r"""Beams that are no rings: a table of elevations and azimuths, from a CSV or from a formula.

The formulas are models of sensors whose pattern does not repeat; each gives one frame of :math:`n` beams, with azimuth
and elevation between the ends of the field of view. With :math:`u, v` from 0 to 1 across it:

- *rosette*: two prisms of equal deflection that turn :math:`p` and :math:`q` times in a frame steer the beam along
  :math:`2u - 1 = (\cos 2\pi p t + \cos 2\pi q t) / 2`, :math:`2v - 1 = (\sin 2\pi p t + \sin 2\pi q t) / 2`, with
  :math:`t = (k + 1/2) / n` (a Risley pair at small angles: Marshall 1999, Risley prism scan patterns, Proc. SPIE 3787);
- *even*: :math:`u = (k + 1/2) / n`, :math:`v = frac(1/2 + k (\sqrt 5 - 1) / 2)`, a Kronecker lattice.

Angles are rounded to 1e-6 degree.
"""

from __future__ import annotations

import csv
import hashlib
import math
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import cosdg, sindg

from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.core.reading import limits
from pipeline.scenario.sensors import PatternModel

COLUMNS = ("elevation_deg", "azimuth_deg")
_LARGEST_DEG = {"elevation_deg": 90.0, "azimuth_deg": 360.0}
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
_DIGITS = 6
_GAP_DEG = 5.0
"""Azimuths that leave no wider gap go all round."""
_SAME_DEG = 1e-6
"""Gaps that differ by less are equally wide."""


class BeamTable:
    """Elevation and azimuth of each beam in the sensor's frame, degrees, (n,) float64 each, n > 0; never changed.

    Tables of the same angles are equal, and can be keys.
    """

    def __init__(self, elevation_deg: NDArray[np.float64], azimuth_deg: NDArray[np.float64]) -> None:
        self.elevation_deg, self.azimuth_deg = (np.array(a, dtype=np.float64) for a in (elevation_deg, azimuth_deg))
        for angles in (self.elevation_deg, self.azimuth_deg):
            angles.flags.writeable = False
        self._digest = hashlib.sha256(self.elevation_deg.tobytes() + self.azimuth_deg.tobytes()).digest()

    def __len__(self) -> int:
        return len(self.elevation_deg)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, BeamTable) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)

    @property
    def azimuth_span_deg(self) -> tuple[float, float] | None:
        """First and last azimuth of the smallest arc that holds all beams, counter-clockwise; None for all round: no
        gap is wide, or several are equally wide, as in a coarse table of a whole turn."""
        at = np.unique(np.mod(self.azimuth_deg, 360.0))
        gaps = np.diff(at, append=at[0] + 360.0)
        widest = int(np.argmax(gaps))
        if gaps[widest] <= _GAP_DEG or np.count_nonzero(gaps > gaps[widest] - _SAME_DEG) > 1:
            return None
        first = float(at[(widest + 1) % len(at)])
        first -= 360.0 if first > 180.0 else 0.0
        return first, first + 360.0 - float(gaps[widest])


def repeated(table: BeamTable) -> list[tuple[int, int]]:
    """Beams that point where an earlier one does, to 1e-6 degree: (beam, the earlier one), by beam."""
    steps, turn = 10**_DIGITS, 360 * 10**_DIGITS
    elevation, azimuth = (np.rint(a * steps).astype(np.int64) for a in (table.elevation_deg, table.azimuth_deg))
    direction = elevation * turn + np.where(np.abs(elevation) == 90 * steps, 0, azimuth % turn)
    _, first, which = np.unique(direction, return_index=True, return_inverse=True)
    earlier = first[which]
    return [(int(beam), int(earlier[beam])) for beam in np.flatnonzero(earlier != np.arange(len(table)))]


def read(path: Path) -> BeamTable:
    """Read a CSV with the columns ``elevation_deg`` and ``azimuth_deg``, one row a beam; others are not read.

    Raises
    ------
    InputError
        Naming file, row and value.
    """
    return _read(path, files.sha256_of(path))


@lru_cache(maxsize=4)
def _read(path: Path, _content: str) -> BeamTable:
    """Read once for all who ask."""
    angles: list[tuple[float, float]] = []
    most = limits.BEAMS.most
    limits.size_of(path, limits.FILE)
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file, skipinitialspace=True)
            names = list(rows.fieldnames or ())
            for name in COLUMNS:
                if (stands := names.count(name)) != 1:
                    found = f"has {'two columns' if stands else 'no column'} {name}"
                    raise InputError(path, found, f"the columns {', '.join(COLUMNS)}, with commas between them")
            for number, row in enumerate(rows):
                if None in row:  # a comma inside a number would move all that follows into other columns
                    what = f"has {len(names) + len(row[None])} values for {len(names)} columns"
                    raise InputError(f"{path}: beam {number}", what, "one value a column, with decimal points")
                elevation_deg, azimuth_deg = (_angle(path, number, name, row[name]) for name in COLUMNS)
                angles.append((elevation_deg, azimuth_deg))
                if len(angles) > most:
                    raise InputError(path, f"has more than {most:,} beams", limits.BEAMS.right)
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, f"cannot be read as CSV ({error})", "UTF-8 text with a header row") from None
    if not angles:
        raise InputError(path, "holds no beam", "one row a beam")
    table = np.array(angles)
    return BeamTable(table[:, 0], table[:, 1])


def _angle(path: Path, number: int, name: str, text: str | None) -> float:
    most = _LARGEST_DEG[name]
    try:
        angle = float(text or "")
    except ValueError:
        angle = math.nan
    if not abs(angle) <= most:
        raise InputError(f"{path}: beam {number}: {name}", f"{text!r}", f"a number between {-most:g} and {most:g}")
    return angle


def of_pattern(pattern: PatternModel) -> BeamTable:
    """The beams that a formula gives; see the module."""
    k = np.arange(pattern.samples)
    if pattern.turns is not None:
        first, second = (np.mod(360.0 * turns * (k + 0.5) / pattern.samples, 360.0) for turns in pattern.turns)
        u, v = (0.5 + 0.25 * (wave(first) + wave(second)) for wave in (cosdg, sindg))
    else:
        u, v = (k + 0.5) / pattern.samples, np.mod(0.5 + k * _GOLDEN, 1.0)
    spans = (pattern.elevation_deg, v), (pattern.azimuth_deg, u)
    elevation_deg, azimuth_deg = (np.round(low + (high - low) * share, _DIGITS) for (low, high), share in spans)
    return BeamTable(elevation_deg, azimuth_deg)
