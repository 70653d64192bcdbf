"""The keys of ``[sensors.<name>]``: a sensor of the user's."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from pipeline.core.strict_model import StrictModel
from pipeline.scenario.types import NotNegative, Positive

_OPTICS = ("wavelength_nm", "divergence_mrad", "rated_range_m", "rated_reflectivity")
_MOST_BEAMS = 10_000_000


class SensorModel(StrictModel):
    """A sensor of the user's. Elevations are listed, or uniform between two when ``channels`` is given."""

    elevations_deg: tuple[Annotated[float, Field(ge=-90, le=90)], ...] = Field(
        min_length=1, description="One a ring; or the first and the last of `channels` uniform ones"
    )
    channels: int | None = Field(None, ge=1, description="Rings, uniform between two elevations_deg")
    azimuth_offsets_deg: tuple[float, ...] = Field((), description="One a ring, added to each azimuth; none: all 0")
    azimuth_step_deg: Positive = Field(description="Divides 360")
    range_m: Positive
    wavelength_nm: Positive = Field(905.0, description="Of the laser; only effects ask")
    divergence_mrad: tuple[NotNegative, NotNegative] = Field(
        (3.0, 1.5), description="Full angle of a beam across and along the elevation; only effects ask"
    )
    rated_range_m: Positive | None = Field(
        None, description="A target of rated_reflectivity, met squarely, is just noticed here; only effects ask"
    )
    rated_reflectivity: Positive = Field(0.8, description="See rated_range_m; only effects ask")

    @property
    def optics(self) -> dict[str, Any]:
        """What effects ask of the laser and the receiver."""
        return {name: getattr(self, name) for name in _OPTICS}

    @model_serializer(mode="wrap")
    def _without_defaults(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without the optics that the user left out: what no effect asks for changes no artefact."""
        return {name: v for name, v in plain(self).items() if name not in _OPTICS or name in self.model_fields_set}

    @model_validator(mode="after")
    def _consistent(self) -> SensorModel:
        listed = len(self.elevations_deg)
        if self.channels not in (None, listed) and listed != 2:
            raise ValueError(
                f"channels = {self.channels} needs elevations_deg with 2 values (uniform) or {self.channels},"
                f" found {listed}"
            )
        rings = self.channels or listed
        if rings * 360.0 / self.azimuth_step_deg > _MOST_BEAMS:
            raise ValueError(
                f"{rings} rings every {self.azimuth_step_deg:g} degrees are more than {_MOST_BEAMS:,} beams"
            )
        if self.azimuth_offsets_deg and len(self.azimuth_offsets_deg) != rings:
            raise ValueError(
                f"azimuth_offsets_deg has {len(self.azimuth_offsets_deg)} values,"
                f" one for each of {rings} rings is needed"
            )
        turns = 360.0 / self.azimuth_step_deg
        if abs(turns - round(turns)) > 1e-9 * turns:
            raise ValueError(f"azimuth_step_deg = {self.azimuth_step_deg:g} does not divide 360")
        return self
