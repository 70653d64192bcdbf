"""The keys of ``[effects.<name>]``: parameters of the effects that extend the plain simulation.

The parameters are defined here, so that a scenario is checked, and completed by editors, without importing any effect.
What an effect does, its source and its limits are documented in its module in :mod:`egvs.effects`. Effects of other
packages (entry points ``egvs.effects``) have models of their own, which are imported only when a scenario names them.
"""

from __future__ import annotations

import difflib
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import PydanticCustomError

from egvs.core import plugins
from egvs.scenario.fields import Positive, Reflectivity, StrictModel

GROUP = "egvs.effects"
"""Entry points of effects, including the built-in ones."""


class EffectParameters(StrictModel):
    """Base of the parameters of an effect."""


class RangeLimitParameters(EffectParameters):
    """Losses of returns by range and reflectivity, and a constant share; each key replaces the value of all sensors."""

    reflectivity: float | None = Field(
        None, gt=0, description="Reflectivity of all road users. By default that of each class: 0.03"
    )
    incidence_deg: float = Field(
        0.0,
        ge=0,
        lt=90,
        description="Angle between the beam and the normal of road users, besides that in reflectivity",
    )
    softness: float | None = Field(
        None, ge=0, description="Standard deviation of the logarithm of the received power. By default each sensor's"
    )
    dropout: float | None = Field(None, ge=0, le=1, description="Share lost at any range. By default each sensor's")
    rated_range_m: float | None = Field(None, gt=0, description="Rated range, instead of each sensor's")
    rated_reflectivity: Reflectivity | None = Field(
        None, description="Rated reflectivity, up to 1, instead of each sensor's"
    )


class RainParameters(EffectParameters):
    """Two-way extinction by rain."""

    rate_mm_h: float = Field(ge=0, le=300, description="Rain rate: 2 is light, 10 moderate, 50 violent")
    law: Literal["japan", "france", "itu2025", "goodin"] = Field(
        "japan", description="Power law from rain rate to extinction; docs/effects.md lists their sources"
    )


class FogParameters(EffectParameters):
    """Two-way extinction by fog."""

    visibility_m: float = Field(gt=0, description="Visibility: below 1000 in fog, below 200 in dense fog")
    model: Literal["kim", "kruse"] = Field("kim", description="Model for the exponent of the wavelength")
    contrast: float = Field(
        0.02, gt=0, lt=1, description="Contrast of visibility_m; 0.05 for meteorological optical range"
    )


class DropoutParameters(EffectParameters):
    """A constant share of returns is lost."""

    share: float = Field(ge=0, le=1, description="Share of the returns that are lost")


_Share = Annotated[float, Field(ge=0, le=1)]


class SurfaceLossesParameters(EffectParameters):
    """Returns lost at grazing incidence, on dark vehicles and on their windows, in simulated point clouds."""

    grazing_loss: _Share = Field(0.66, description="Share of the returns that are lost at the most grazing incidence")
    grazing_deg: float = Field(86.0, ge=0, le=90, description="Angle of incidence at which half of them are lost")
    grazing_width_deg: float = Field(0.18, gt=0, le=30, description="Scale of the logistic increase of this loss")
    dark_share: _Share = Field(0.12, description="Share of dark vehicles")
    dark_loss: _Share = Field(0.4, description="Share of the returns from a dark vehicle that are lost")
    glass_loss: _Share = Field(0.21, description="Share of the returns from windows that are lost")


class RangeNoiseParameters(EffectParameters):
    """Range noise that grows with range and incidence, in simulated point clouds."""

    footprint_mrad: float = Field(0.037, ge=0, le=10, description="Noise by range and tangent of the incidence, 1e-3")
    max_sigma_m: float = Field(0.1, ge=0, le=10, description="Largest standard deviation that is added")


def _parse_all(frames: object) -> object:
    return 0 if frames == "all" else frames


class MovingOcclusionParameters(EffectParameters):
    """Vehicles occlude what is behind them."""

    method: Literal["frames", "independent"] = Field(
        "frames", description="Replay recorded frames, or take the voxels of the TPOG as independent"
    )
    frames: Annotated[int, Field(ge=0, strict=True), BeforeValidator(_parse_all)] = Field(
        500, description='Number of recorded frames that are replayed, evenly spaced; 0 or "all" for all'
    )

    @field_validator("frames")
    @classmethod
    def _check_frames(cls, frames: int, info: ValidationInfo) -> int:
        if info.data.get("method") == "independent":
            raise PydanticCustomError("unused_key", 'has no effect with method = "independent"')
        return frames


_Mrad = Annotated[float, Field(ge=0, le=100)]


class DivergenceParameters(EffectParameters):
    """A beam as a cone of weighted sub-beams."""

    sub_beams: Literal[1, 7, 19] = Field(7, description="Sub-beams per beam; 1 is the plain beam")
    divergence_mrad: tuple[_Mrad, _Mrad] | None = Field(
        None, description="Full angles in azimuth and elevation, at 1/e^2. By default those of each sensor"
    )


class MixedReturnsParameters(DivergenceParameters):
    """Returns between two surfaces where a beam meets an edge, in simulated point clouds."""

    pulse_ns: float = Field(5.0, gt=0, le=100, description="Duration of the pulse: 5 resolves surfaces 0.75 m apart")
    returns: Literal["strongest", "first"] = Field("strongest", description="The echo that the sensor reports")


class MountSwayParameters(EffectParameters):
    """A pose averaged over a distribution of tilts."""

    tilt_deg: float = Field(ge=0, le=10, description="Standard deviation of the tilt about each horizontal axis")
    samples: Literal[1, 4, 9, 16] = Field(4, description="Number of poses that are averaged; 1 is the pole at rest")


class FoliageParameters(EffectParameters):
    """Porous tree crowns."""

    leaf_area_density: float = Field(
        1.0, ge=0, le=1e15, description="Leaf area per volume of crown in summer, m2/m3: 0.5 is thin, 2 is dense"
    )
    season: Literal["summer", "autumn", "winter"] | Annotated[float, Field(ge=0, le=1)] = Field(
        "summer", description="Season, or the share of the summer's optical depth, 0 to 1"
    )
    projection: float = Field(0.5, gt=0, le=1, description="Mean projection G of a unit of leaf area")
    step_m: float = Field(2.0, ge=0.01, le=100, description="Maximum length of the steps into which a crown is divided")


class SlopeParameters(EffectParameters):
    """Pitched vehicles, and a ground that follows the roads; no parameters."""


class VehicleParts(EffectParameters):
    """The parts of a kind of vehicle, from front to rear."""

    parts_m: tuple[Positive, ...] = Field(min_length=1, max_length=8, description="Length of each part")
    hinges_m: tuple[Positive, ...] = Field(
        (), description="Distance of each joint from the front bumper. By default halfway between its parts"
    )
    axles_m: tuple[Positive, ...] = Field(
        (),
        description="Distance from each joint back to the axle of its rear part. By default 0.75 of the length of the "
        "part",
    )

    @model_validator(mode="after")
    def _check_joints(self) -> VehicleParts:
        joints = len(self.parts_m) - 1
        for key in ("hinges_m", "axles_m"):
            count = len(getattr(self, key))
            if count not in (0, joints):
                raise ValueError(f"expected {joints} {key} for {joints + 1} parts, or none, got {count}")
        if list(self.hinges_m) != sorted(self.hinges_m):
            raise ValueError("hinges_m must be ascending: they are distances from the front bumper")
        return self


class ArticulatedParameters(EffectParameters):
    """Articulated vehicles, whose rear parts swing."""

    kinds: dict[str, VehicleParts] = Field(
        default_factory=dict, description="Parts of a kind of vehicle, by the name of its SUMO vType"
    )
    auto: bool = Field(True, description="Also divide buses, coaches, trucks and trailers of 16 m or more into parts")


BoxSize = Annotated[tuple[Positive, Positive, Positive], Field(description="Length, width and height of the box")]
PerHour = Annotated[float, Field(ge=0, le=100_000, description="Departures per hour in the whole network")]


class PedestriansBicyclesParameters(EffectParameters):
    """Pedestrians and bicycles in addition to the vehicles of the scenario."""

    pedestrians_per_h: PerHour = 0.0
    bicycles_per_h: PerHour = 0.0
    pedestrian_m: BoxSize = (0.8, 0.6, 1.73)
    bicycle_m: BoxSize = (1.76, 0.6, 1.73)


class EffectsConfig(StrictModel):
    """Effects beyond the plain simulation; `egvs effects` prints names and parameters."""

    model_config = ConfigDict(extra="allow", json_schema_extra={"additionalProperties": False})

    range_limit: RangeLimitParameters | Literal[False] | None = Field(
        None, description="Losses of returns. By default they act where they can change a result; false: never"
    )
    rain: RainParameters | None = None
    fog: FogParameters | None = None
    dropout: DropoutParameters | None = None
    surface_losses: SurfaceLossesParameters | None = None
    range_noise: RangeNoiseParameters | None = None
    moving_occlusion: MovingOcclusionParameters | None = None
    divergence: DivergenceParameters | None = None
    mount_sway: MountSwayParameters | None = None
    mixed_returns: MixedReturnsParameters | None = None
    foliage: FoliageParameters | None = None
    pedestrians_bicycles: PedestriansBicyclesParameters | None = None
    articulated: ArticulatedParameters | None = None
    slope: SlopeParameters | None = None

    __pydantic_extra__: dict[str, Any]
    BUILT_IN: ClassVar[tuple[str, ...]]
    """The built-in effects, in the order in which they are composed."""

    @property
    def named(self) -> dict[str, EffectParameters]:
        """The effects that the scenario names, in the order of composition: built-in ones, then those of plugins."""
        built_in = {name: getattr(self, name) for name in self.BUILT_IN if getattr(self, name)}
        return built_in | self.__pydantic_extra__

    def only(self, *names: str) -> Self:
        """Return the named effects, limited to ``names``."""
        kept: dict[str, Any] = {name: value for name, value in self.named.items() if name in names}
        if self.range_limit is not None and "range_limit" not in kept:
            kept["range_limit"] = False  # None would let it act where it can change a result
        return self.model_validate(kept)

    def without(self, name: str) -> Self:
        """Return the named effects except one, which is off."""
        others: dict[str, Any] = {other: value for other, value in self.named.items() if other != name}
        if name == "range_limit" or self.range_limit is False:
            others["range_limit"] = False  # None would let it act where it can change a result
        return self.model_validate(others)

    @model_validator(mode="after")
    def _check_plugins(self) -> Self:
        others = self.__pydantic_extra__
        for name in sorted(others):
            others[name] = _check_plugin_parameters(name, others.pop(name))
        return self

    @model_serializer(mode="plain")
    def _serialize(self) -> dict[str, Any]:
        """As the user wrote them, without defaults."""
        written = {name: value.model_dump(mode="json", exclude_unset=True) for name, value in self.named.items()}
        return {"range_limit": False, **written} if self.range_limit is False else written


EffectsConfig.BUILT_IN = tuple(EffectsConfig.model_fields)


def load_effect(name: str) -> Any:
    """Import the class of an effect; MissingBackendError when it cannot be imported or is not one."""
    effect_class = plugins.load_plugin(GROUP, name)
    required = ("NAME", "SOURCE", "STAGE", "KIND", "Model.from_dict")
    expected = "a subclass of Detect or another kind in egvs.effects.base, with NAME, SOURCE and Model"
    plugins.check_plugin(GROUP, name, effect_class, required, expected)
    return effect_class


def _check_plugin_parameters(name: str, values: object) -> EffectParameters:
    """Return the parameters of an effect of another package."""
    known = list(dict.fromkeys([*EffectsConfig.BUILT_IN, *plugins.plugin_names(GROUP)]))
    if name not in known:
        similar = difflib.get_close_matches(name, known, 1, 0.4)
        hint = f"Did you mean {similar[0]}?" if similar else f"Known effects are {', '.join(known)}."
        raise PydanticCustomError("unknown_effect", "unknown effect", {"name": name, "hint": hint})
    if isinstance(values, EffectParameters):
        return values
    model: type[EffectParameters] = load_effect(name).Model
    try:
        return model.from_dict(values)  # type: ignore[arg-type]
    except ValidationError as error:
        context = {"name": name, "model": model, "error": error}
        raise PydanticCustomError("effect_parameters", "invalid parameters", context) from None
