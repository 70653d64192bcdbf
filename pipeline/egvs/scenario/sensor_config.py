"""The keys of ``[sensors.<name>]``: a sensor of the user's. The catalogue's entries have the same keys."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from egvs.core import limits
from egvs.scenario.fields import NotNegative, Positive, StrictModel

MAX_RINGS = 10_000
"""No sensor has a tenth of them."""

_OPTICS_KEYS = ("wavelength_nm", "divergence_mrad", "rated_range_m", "rated_reflectivity", "range_sigma_m")
_FIELD_OF_VIEW_KEYS = ("azimuth_deg", "beams", "pattern")
_RING_KEYS = ("channels", "azimuth_offsets_deg", "azimuth_step_deg", "azimuth_deg")

Elevation = Annotated[float, Field(ge=-90, le=90)]
Azimuth = Annotated[float, Field(ge=-360, le=360)]
Turns = Annotated[float, Field(ge=-1e6, le=1e6)]
"""Of more, no digit after the whole turns is left."""


def _check_beams(beams: float, what: str) -> None:
    if not beams <= limits.BEAMS.maximum:
        raise ValueError(f"{what} has more than {limits.BEAMS.maximum:,} beams. {limits.BEAMS.hint}")


class BeamPatternConfig(StrictModel):
    """Beams from a formula, for sensors whose pattern does not repeat: what one frame of it may look like, a model."""

    kind: Literal["rosette", "even"] = Field(
        description="'rosette': two prisms of equal deflection that turn at different speeds; 'even': evenly spread"
    )
    samples: int = Field(ge=1, description="Beams of one frame")
    azimuth_deg: tuple[Azimuth, Azimuth] = Field(description="From where to where")
    elevation_deg: tuple[Elevation, Elevation] = Field(description="From where to where")
    turns: tuple[Turns, Turns] | None = Field(None, description="Of the two prisms in one frame, for a rosette")

    @model_validator(mode="after")
    def _consistent(self) -> BeamPatternConfig:
        _check_beams(self.samples, "samples")
        for key in ("azimuth_deg", "elevation_deg"):
            low, high = getattr(self, key)
            if not low < high:
                raise ValueError(f"{key} = [{low:g}, {high:g}] does not go up")
        if (self.turns is None) != (self.kind == "even"):
            raise ValueError("turns belong to a rosette" if self.turns else "a rosette needs turns")
        return self


class SensorConfig(StrictModel):
    """A sensor of the user's: rings at listed or uniform elevations, all round or in a field of view; a table of beams;
    or beams from a formula."""

    elevations_deg: tuple[Elevation, ...] = Field(
        (), description="One a ring; or the first and the last of `channels` uniform ones"
    )
    channels: int | None = Field(None, ge=1, le=MAX_RINGS, description="Rings, uniform between two elevations_deg")
    azimuth_offsets_deg: tuple[Azimuth, ...] = Field((), description="One a ring, added to each azimuth; none: all 0")
    azimuth_step_deg: Positive | None = Field(
        None, description="Between two beams of a ring; divides 360, or the width of azimuth_deg"
    )
    azimuth_deg: tuple[Azimuth, Azimuth] | None = Field(
        None, description="First and last azimuth of a ring, counter-clockwise from the x axis; none: all round"
    )
    beams: str | None = Field(
        None, description="Instead of rings: a CSV with the columns elevation_deg and azimuth_deg, one row a beam"
    )
    pattern: BeamPatternConfig | None = None
    range_m: Positive
    wavelength_nm: Positive = Field(905.0, description="Of the laser; only effects ask")
    divergence_mrad: tuple[NotNegative, NotNegative] = Field(
        (3.0, 1.5), description="Full angle of a beam across and along the elevation; only effects ask"
    )
    rated_range_m: Positive | None = Field(
        None, description="A target of rated_reflectivity, met squarely, is just noticed here; only effects ask"
    )
    rated_reflectivity: Positive = Field(0.8, description="See rated_range_m; only effects ask")

    range_sigma_m: NotNegative = Field(
        0.03, description="Standard deviation of a measured range; only point clouds with traffic ask"
    )

    @property
    def optics(self) -> dict[str, Any]:
        """What effects ask of the laser and the receiver."""
        return {name: getattr(self, name) for name in _OPTICS_KEYS}

    @property
    def rings(self) -> int:
        """How many rings; 0 for a table or a pattern."""
        return self.channels or len(self.elevations_deg)

    @property
    def azimuths(self) -> int:
        """Beams of a ring."""
        return 0 if self.azimuth_step_deg is None else round(self._azimuths())

    def _azimuths(self) -> float:
        """Beams of a ring, not rounded; without end for a step that is next to nothing."""
        if self.azimuth_step_deg is None:
            return 0.0
        if self.azimuth_deg is None:
            return 360.0 / self.azimuth_step_deg
        return (self.azimuth_deg[1] - self.azimuth_deg[0]) / self.azimuth_step_deg + 1.0

    @model_serializer(mode="wrap")
    def _without_defaults(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without optics and field of view that the user left out: what nobody asks for changes no artefact."""
        quiet = {*_OPTICS_KEYS, *_FIELD_OF_VIEW_KEYS} - self.model_fields_set
        return {name: value for name, value in plain(self).items() if name not in quiet}

    @model_validator(mode="after")
    def _one_source(self) -> SensorConfig:
        given = [key for key in ("elevations_deg", "beams", "pattern") if getattr(self, key)]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            raise ValueError(f"exactly one of elevations_deg, beams and pattern is needed, found {found}")
        if given != ["elevations_deg"]:
            if idle := [key for key in _RING_KEYS if getattr(self, key)]:
                raise ValueError(f"{', '.join(idle)} would act on nothing beside {given[0]}")
        elif self.azimuth_step_deg is None:
            raise ValueError("azimuth_step_deg is needed beside elevations_deg")
        return self

    @model_validator(mode="after")
    def _check_rings(self) -> SensorConfig:
        listed, rings = len(self.elevations_deg), self.rings
        if self.channels not in (None, listed) and listed != 2:
            raise ValueError(
                f"channels = {self.channels} needs elevations_deg with 2 values (uniform) or {self.channels},"
                f" found {listed}"
            )
        if self.azimuth_step_deg is not None:
            _check_beams(rings * self._azimuths(), f"{rings} rings every {self.azimuth_step_deg:g} degrees")
        if self.azimuth_offsets_deg and len(self.azimuth_offsets_deg) != rings:
            raise ValueError(
                f"azimuth_offsets_deg has {len(self.azimuth_offsets_deg)} values,"
                f" one for each of {rings} rings is needed"
            )
        return self

    @model_validator(mode="after")
    def _check_steps(self) -> SensorConfig:
        if self.azimuth_step_deg is None:
            return self
        width, what = 360.0, "360"
        if self.azimuth_deg is not None:
            width = self.azimuth_deg[1] - self.azimuth_deg[0]
            what = f"the {width:g} degrees of azimuth_deg"
            if not 0 < width < 360:
                first, last = self.azimuth_deg
                raise ValueError(
                    f"azimuth_deg = [{first:g}, {last:g}] must go up, by less than 360 degrees; all round without it"
                )
        steps = width / self.azimuth_step_deg
        if abs(steps - round(steps)) > 1e-9 * steps:
            raise ValueError(f"azimuth_step_deg = {self.azimuth_step_deg:g} does not divide {what}")
        return self
