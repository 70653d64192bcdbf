"""The reference system that exported positions are in: the scenario's own, degrees (WGS 84), or local metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import InputError
from pipeline.formats import crs as systems
from pipeline.formats.crs import WorldFrame

Floats = NDArray[np.float64]

SCENARIO, DEGREES = "scenario", "wgs84"
CHOICES = (SCENARIO, DEGREES)

_DIGITS_M, _DIGITS_DEG = 6, 9  # a micrometre, 0.1 mm


@dataclass(frozen=True)
class Reference:
    """A reference system, and how world-frame positions get there.

    Attributes
    ----------
    crs
        As PROJ and GDAL understand it: ``"EPSG:32632"``, WKT.
    words
        What a user calls it.
    frame
        Where the world frame lies; None for local metres.
    is_degrees
        Whether coordinates are longitude and latitude.
    """

    crs: str
    words: str
    frame: WorldFrame | None
    is_degrees: bool

    @classmethod
    def of(cls, frame: WorldFrame | None, choice: str, center_m: tuple[float, float], place: object) -> Reference:
        """The system of a choice in :data:`CHOICES`.

        Parameters
        ----------
        center_m
            The middle of the region of interest, world frame.
        place
            The run, for messages.

        Raises
        ------
        InputError
            For degrees of a scenario that does not say where its world frame lies.
        """
        if choice == DEGREES:
            if frame is None:
                found = "has no degrees: nothing says where the scenario's world frame lies on the Earth"
                right = (
                    "[crs] with epsg in the scenario, or a network with a <location>; or another format in local metres"
                )
                raise InputError(place, found, f"{right} (--crs scenario)")
            return cls("EPSG:4326", "longitude and latitude (WGS 84)", frame, is_degrees=True)
        if frame is None:
            words = "local metres of the world frame, as the scenario does not say where on the Earth it lies"
            return cls(systems.LOCAL_METRES, words, None, is_degrees=False)
        known = systems.named(frame, center_m)
        return cls(known, systems.parsed(known, str(place)).name, frame, is_degrees=False)

    @property
    def is_local(self) -> bool:
        """Whether nobody knows where on the Earth positions are."""
        return self.frame is None

    def of_world(self, xy_m: Floats) -> Floats:
        """Coordinates (n, 2) of world-frame positions (n, 2) in metres."""
        if self.frame is None:
            return xy_m
        if self.is_degrees:
            return np.round(self.frame.to_degrees(xy_m), _DIGITS_DEG)
        eastings: Floats = np.subtract(xy_m, self.frame.offset_m, dtype=np.float64)
        return np.round(eastings, _DIGITS_M)

    def to_world(self, xy: Floats) -> Floats:
        """World-frame positions (n, 2) in metres of coordinates (n, 2)."""
        if self.frame is None:
            return xy
        return self.frame.from_degrees(xy) if self.is_degrees else np.add(xy, self.frame.offset_m)

    def geometries(self, shapes: Any) -> Any:
        """Shapely geometries of the world frame, (n,) object, in this system."""
        import shapely

        return shapely.transform(shapes, self.of_world)
