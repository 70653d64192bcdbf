"""The keys of ``[sensors.<name>]``: a custom sensor. The entries of the sensor catalogue have the same keys."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from egvs.core import limits
from egvs.scenario.fields import NotNegative, Positive, Reflectivity, SensorMount, StrictModel

MAX_RINGS = 10_000
"""More than ten times as many as any sensor has."""

OPTICS_KEYS = (
    "wavelength_nm", "divergence_mrad", "rated_range_m", "rated_reflectivity", "softness", "dropout", "range_sigma_m",
)  # fmt: skip
"""Keys of the laser and the receiver."""
_FIELD_OF_VIEW_KEYS = ("azimuth_deg", "beams", "pattern")
_RING_KEYS = ("channels", "azimuth_offsets_deg", "azimuth_step_deg", "azimuth_deg")
_FILE_RING_KEYS = ("azimuth_step_deg", "azimuth_deg")
"""They complete a file of rings; :mod:`egvs.sensors.sensor` refuses them with other files."""

Elevation = Annotated[float, Field(ge=-90, le=90)]
Azimuth = Annotated[float, Field(ge=-360, le=360)]
Turns = Annotated[float, Field(ge=-1e6, le=1e6)]
"""Beyond this, float64 does not resolve the fraction of a turn."""


def _check_beams(beams: float, what: str) -> None:
    if not beams <= limits.BEAMS.maximum:
        raise ValueError(f"{what} make more than {limits.BEAMS.maximum:,} beams. {limits.BEAMS.hint}")


class BeamPatternConfig(StrictModel):
    """One frame of a sensor whose scan pattern does not repeat: a formula, or a file of directions."""

    kind: Literal["rosette", "even", "file"] = Field(
        description="'rosette': two prisms of equal deflection that rotate at different speeds; 'even': evenly spread;"
        " 'file': directions with dwell times, scored as expected hits over one frame"
    )
    samples: int = Field(ge=1, description="Number of beams per frame")
    azimuth_deg: tuple[Azimuth, Azimuth] | None = Field(None, description="Lowest and highest azimuth, of a formula")
    elevation_deg: tuple[Elevation, Elevation] | None = Field(
        None, description="Lowest and highest elevation, of a formula"
    )
    file: str | None = Field(
        None, description="A CSV file of directions with the columns elevation_deg, azimuth_deg, dwell_s"
    )
    turns: tuple[Turns, Turns] | None = Field(None, description="Rotations of the prisms of a rosette per frame")

    @model_validator(mode="after")
    def _check_values(self) -> BeamPatternConfig:
        _check_beams(self.samples, "samples")
        if (self.kind == "file") != (self.file is not None):
            raise ValueError("file must be set for the kind 'file', and only for it")
        for key in ("azimuth_deg", "elevation_deg"):
            span = getattr(self, key)
            if (span is None) != (self.kind == "file"):
                raise ValueError(f"{key} must be set for a formula, and only for a formula")
            if span is not None and not span[0] < span[1]:
                raise ValueError(f"{key} = [{span[0]:g}, {span[1]:g}] is not ascending")
        if (self.kind == "rosette") != (self.turns is not None):
            raise ValueError("turns must be set for a rosette, and only for a rosette")
        return self

    @model_serializer(mode="wrap")
    def _serialize(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what only a file has, so that formulas keep their cache keys."""
        values: dict[str, Any] = serialize(self)
        unused = {"azimuth_deg", "elevation_deg"} if self.kind == "file" else {"file"}
        return {name: value for name, value in values.items() if name not in unused}


class SensorConfig(StrictModel):
    """A custom sensor. Its beams are rings at listed or uniform elevations, a table, or a formula."""

    elevations_deg: tuple[Elevation, ...] = Field(
        (), description="Elevation of each ring; or the first and the last of `channels` uniform ones"
    )
    channels: int | None = Field(None, ge=1, le=MAX_RINGS, description="Number of rings between two elevations_deg")
    azimuth_offsets_deg: tuple[Azimuth, ...] = Field((), description="Azimuth offset of each ring. By default 0")
    azimuth_step_deg: Positive | None = Field(
        None, description="Azimuth between neighbouring beams of a ring; divides 360 or the width of azimuth_deg"
    )
    azimuth_deg: tuple[Azimuth, Azimuth] | None = Field(
        None, description="First and last azimuth of a ring, counter-clockwise from x. By default the full circle"
    )
    beams: str | None = Field(
        None,
        description="A file of beams or rings: a table (CSV, xlsx, ods), an Ouster's metadata (JSON), angles of Hesai"
        " or RoboSense (CSV)",
    )
    pattern: BeamPatternConfig | None = None
    range_m: Positive = Field(description="Maximum range")
    wavelength_nm: Positive = Field(905.0, description="Wavelength of the laser; for effects only")
    divergence_mrad: tuple[NotNegative, NotNegative] = Field(
        (3.0, 1.5), description="Full divergence angles in azimuth and elevation, at 1/e^2; for effects only"
    )
    rated_range_m: Positive | None = Field(
        None, description="Range at which a target of rated_reflectivity is just detected; without it, no losses"
    )
    rated_reflectivity: Reflectivity = Field(0.8, description="Reflectivity of the target of rated_range_m, up to 1")
    softness: NotNegative = Field(
        1.0, description="Standard deviation of the logarithm of the power that vehicles return; fitted on two units"
    )
    dropout: float = Field(
        0.05, ge=0, le=1, description="Share of returns from vehicles that are lost at any range; fitted on two units"
    )

    range_sigma_m: NotNegative = Field(
        0.03, description="Standard deviation of measured ranges; used for point clouds with traffic only"
    )
    mount: SensorMount = Field(
        "upright", description="'inverted': upside down wherever no site says otherwise; its x axis keeps its direction"
    )

    @property
    def beam_file(self) -> tuple[str, str] | None:
        """Key and name of the file that states the beams or directions; None without a file."""
        if self.beams is not None:
            return "beams", self.beams
        if self.pattern is not None and self.pattern.file is not None:
            return "pattern.file", self.pattern.file
        return None

    @property
    def optics(self) -> dict[str, Any]:
        """Properties of the laser and the receiver, which effects use."""
        return {name: getattr(self, name) for name in OPTICS_KEYS}

    @property
    def rings(self) -> int:
        """Number of rings; 0 for a table or a formula."""
        return self.channels or len(self.elevations_deg)

    @property
    def azimuths(self) -> int:
        """Number of beams per ring; 0 for a table or a formula."""
        return round(self._exact_azimuths())

    def _exact_azimuths(self) -> float:
        """Number of beams per ring before rounding; it may be infinite for a tiny step."""
        if self.azimuth_step_deg is None:
            return 0.0
        if self.azimuth_deg is None:
            return 360.0 / self.azimuth_step_deg
        return (self.azimuth_deg[1] - self.azimuth_deg[0]) / self.azimuth_step_deg + 1.0

    @model_serializer(mode="wrap")
    def _serialize(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out optics and field of view that are not set, so that they do not change cache keys."""
        omitted = {*OPTICS_KEYS, *_FIELD_OF_VIEW_KEYS, "mount"} - self.model_fields_set
        return {name: value for name, value in serialize(self).items() if name not in omitted}

    @model_validator(mode="after")
    def _check_source(self) -> SensorConfig:
        sources = [key for key in ("elevations_deg", "beams", "pattern") if getattr(self, key)]
        if len(sources) != 1:
            actual = " and ".join(sources) or "none"
            raise ValueError(f"expected exactly one of elevations_deg, beams and pattern, got {actual}")
        if sources == ["elevations_deg"]:
            if self.azimuth_step_deg is None:
                raise ValueError("elevations_deg needs azimuth_step_deg")
            return self
        if self.azimuth_deg is not None and self.azimuth_step_deg is None:
            raise ValueError("azimuth_deg needs azimuth_step_deg")
        completing = _FILE_RING_KEYS if sources == ["beams"] else ()
        unused = [key for key in _RING_KEYS if getattr(self, key) and key not in completing]
        if unused:
            raise ValueError(f"no effect with {sources[0]}: {', '.join(unused)}")
        return self

    @model_validator(mode="after")
    def _check_rings(self) -> SensorConfig:
        listed = len(self.elevations_deg)
        rings = self.rings
        if self.channels not in (None, listed) and listed != 2:
            raise ValueError(
                f"channels = {self.channels} needs 2 elevations_deg (uniform) or {self.channels}, got {listed}"
            )
        if self.azimuth_step_deg is not None:
            _check_beams(rings * self._exact_azimuths(), f"{rings} rings every {self.azimuth_step_deg:g} degrees")
        offsets = len(self.azimuth_offsets_deg)
        if offsets and offsets != rings:
            raise ValueError(f"expected {rings} azimuth_offsets_deg, one per ring, got {offsets}")
        return self

    @model_validator(mode="after")
    def _check_step(self) -> SensorConfig:
        if self.azimuth_step_deg is None:
            return self
        width = 360.0
        what = "360"
        if self.azimuth_deg is not None:
            first, last = self.azimuth_deg
            width = last - first
            what = f"the {width:g} degrees of azimuth_deg"
            if not 0 < width < 360:
                interval = f"azimuth_deg = [{first:g}, {last:g}]"
                raise ValueError(f"{interval} must be ascending, by less than 360. Omit it for the full circle")
        steps = width / self.azimuth_step_deg
        if abs(steps - round(steps)) > 1e-9 * steps:
            whole = max(1, round(steps))
            nearest = f"The nearest that does is {width / whole!r} ({width:g} / {whole})"
            raise ValueError(f"azimuth_step_deg = {self.azimuth_step_deg:.12g} does not divide {what}. {nearest}")
        return self
