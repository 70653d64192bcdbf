"""The keys of ``[effects.<name>]``: what goes beyond the plain scene, effect by effect.

Parameters stand here, so that a scenario is checked and completed by editors without any effect's code; what an effect
does, its source and its limits stand in its module under :mod:`egvs.effects`. Effects of other packages (entry
points ``egvs.effects``) bring models of their own, which are asked only when a scenario names them.
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
from egvs.scenario.fields import Positive, StrictModel

GROUP = "egvs.effects"
"""The entry points that effects are found by, this program's own too."""


class EffectParameters(StrictModel):
    """Base of the parameters of an effect."""


class RangeLimitParameters(EffectParameters):
    """From how far a target of some reflectivity comes back."""

    reflectivity: float = Field(
        0.1,
        gt=0,
        description="Of the targets, diffuse; a dark vehicle 0.1, a white one 0.8, a retroreflector far above 1",
    )
    incidence_deg: float = Field(0.0, ge=0, lt=90, description="Angle between the beam and the target's normal")
    softness: float = Field(0.3, ge=0, description="Spread of the logarithm of power; 0: all up to the limit")
    rated_range_m: float | None = Field(None, gt=0, description="Instead of each sensor's own")
    rated_reflectivity: float | None = Field(None, gt=0, description="Instead of each sensor's own")


class RainParameters(EffectParameters):
    """Two-way extinction by rain."""

    rate_mm_h: float = Field(ge=0, le=300, description="Rain rate; 2 is light, 10 moderate, 50 violent")
    law: Literal["japan", "france", "itu2025", "goodin"] = Field(
        "japan", description="Which power law; the module's table says whose"
    )


class FogParameters(EffectParameters):
    """Two-way extinction by fog."""

    visibility_m: float = Field(gt=0, description="How far one sees; fog is below 1000, dense fog below 200")
    model: Literal["kim", "kruse"] = Field(
        "kim", description="How the exponent of the wavelength follows from the visibility"
    )
    contrast: float = Field(
        0.02, gt=0, lt=1, description="At which visibility_m was measured; 0.05 for the meteorological optical range"
    )


class DropoutParameters(EffectParameters):
    """A constant share of returns lost."""

    share: float = Field(ge=0, le=1, description="Share of the returns that are lost")


def _all_to_zero(given: object) -> object:
    return 0 if given == "all" else given


class MovingOcclusionParameters(EffectParameters):
    """Vehicles hide what is behind them."""

    method: Literal["frames", "independent"] = Field(
        "frames", description="Replay recorded frames, or take the TPOG's voxels as independent"
    )
    frames: Annotated[int, Field(ge=0, strict=True), BeforeValidator(_all_to_zero)] = Field(
        500,
        description='Recorded frames that are replayed, evenly spaced; 0, "all", or more than there are: all of them',
    )

    @field_validator("frames")
    @classmethod
    def _frames_are_replayed(cls, frames: int, info: ValidationInfo) -> int:
        if info.data.get("method") == "independent":
            raise PydanticCustomError("idle", 'acts on nothing with method = "independent"; remove it')
        return frames


_Mrad = Annotated[float, Field(ge=0, le=100)]


class DivergenceParameters(EffectParameters):
    """A beam as a cone of weighted sub-beams."""

    sub_beams: Literal[1, 7, 19] = Field(7, description="Sub-beams a beam; 1 is the plain beam")
    divergence_mrad: tuple[_Mrad, _Mrad] | None = Field(
        None, description="Full angles across and along the elevation, 1/e^2, in place of the sensors' own"
    )


class MountSwayParameters(EffectParameters):
    """A pose averaged over a tilt distribution."""

    tilt_deg: float = Field(ge=0, le=10, description="Standard deviation of the tilt about each horizontal axis")
    samples: Literal[1, 4, 9, 16] = Field(4, description="Poses that are averaged; 1 is the pole at rest")


class FoliageParameters(EffectParameters):
    """Porous tree crowns."""

    leaf_area_density: float = Field(
        1.0, ge=0, le=1e15, description="Leaf area a volume of crown in summer, m2/m3; 0.5 is thin, 2 is dense"
    )
    season: Literal["summer", "autumn", "winter"] | Annotated[float, Field(ge=0, le=1)] = Field(
        "summer", description="Or the share of the summer's optical depth, 0 to 1"
    )
    projection: float = Field(0.5, gt=0, le=1, description="G, mean projection of a unit of leaf area")
    step_m: float = Field(2.0, ge=0.01, le=100, description="Longest step in which a crown is cut")


class SlopeParameters(EffectParameters):
    """Pitched boxes and a ground that follows the roads; no parameters."""


class VehicleParts(EffectParameters):
    """How a kind of vehicle is put together; each list from front to rear."""

    parts_m: tuple[Positive, ...] = Field(min_length=1, max_length=8, description="Length of each part")
    hinges_m: tuple[Positive, ...] = Field(
        (), description="Each joint's distance from the front bumper; none: in the middle of its gap"
    )
    axles_m: tuple[Positive, ...] = Field(
        (), description="From each joint back to the axle of the part behind it; none: 0.75 of that part"
    )

    @model_validator(mode="after")
    def _fits(self) -> VehicleParts:
        joints = len(self.parts_m) - 1
        for key in ("hinges_m", "axles_m"):
            if (count := len(getattr(self, key))) not in (0, joints):
                raise ValueError(f"{key} has {count} values for {joints + 1} parts, {joints} are needed (or none)")
        if list(self.hinges_m) != sorted(self.hinges_m):
            raise ValueError("hinges_m run back; they count from the front bumper")
        return self


class ArticulatedParameters(EffectParameters):
    """Rear parts of articulated vehicles."""

    kinds: dict[str, VehicleParts] = Field(
        default_factory=dict, description="Kind of vehicle (name of its SUMO vType) -> its parts"
    )
    auto: bool = Field(
        True,
        description="Whether buses, coaches, trucks and trailers of 16 m and more that `kinds` leaves out get parts",
    )


BoxSize = Annotated[tuple[Positive, Positive, Positive], Field(description="Length, width and height of the box")]
PerHour = Annotated[float, Field(ge=0, le=100_000, description="Departures in an hour, in the whole network")]


class PedestriansBicyclesParameters(EffectParameters):
    """People on foot and on bicycles beside the scenario's vehicles."""

    pedestrians_per_h: PerHour = 0.0
    bicycles_per_h: PerHour = 0.0
    pedestrian_m: BoxSize = (0.8, 0.6, 1.73)
    bicycle_m: BoxSize = (1.76, 0.6, 1.73)


class EffectsConfig(StrictModel):
    """What goes beyond the plain scene; `egvs effects` prints names and parameters."""

    model_config = ConfigDict(extra="allow", json_schema_extra={"additionalProperties": False})

    range_limit: RangeLimitParameters | None = None
    rain: RainParameters | None = None
    fog: FogParameters | None = None
    dropout: DropoutParameters | None = None
    moving_occlusion: MovingOcclusionParameters | None = None
    divergence: DivergenceParameters | None = None
    mount_sway: MountSwayParameters | None = None
    foliage: FoliageParameters | None = None
    pedestrians_bicycles: PedestriansBicyclesParameters | None = None
    articulated: ArticulatedParameters | None = None
    slope: SlopeParameters | None = None

    __pydantic_extra__: dict[str, Any]
    BUILT_IN: ClassVar[tuple[str, ...]]
    """This program's own effects, in the order in which they are composed."""

    @property
    def named(self) -> dict[str, EffectParameters]:
        """The effects that the scenario names, in the order of their composition: this program's, then others'."""
        own = {name: getattr(self, name) for name in self.BUILT_IN}
        return {name: value for name, value in own.items() if value is not None} | self.__pydantic_extra__

    def only(self, *names: str) -> Self:
        """Of the named effects, these."""
        return self.model_validate({name: value for name, value in self.named.items() if name in names})

    def without(self, name: str) -> Self:
        """The named effects but one."""
        return self.only(*(other for other in self.named if other != name))

    @model_validator(mode="after")
    def _check_others(self) -> Self:
        others = self.__pydantic_extra__
        for name in sorted(others):
            others[name] = _check_plugin_parameters(name, others.pop(name))
        return self

    @model_serializer(mode="plain")
    def _as_written(self) -> dict[str, Any]:
        return {name: value.model_dump(mode="json", exclude_unset=True) for name, value in self.named.items()}


EffectsConfig.BUILT_IN = tuple(EffectsConfig.model_fields)


def _check_plugin_parameters(name: str, given: object) -> EffectParameters:
    """The parameters of an effect that some other package brings."""
    known = [*EffectsConfig.BUILT_IN, *(n for n in plugins.plugin_names(GROUP) if n not in EffectsConfig.BUILT_IN)]
    if name not in known:
        near = difflib.get_close_matches(name, known, 1, 0.4)
        right = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
        raise PydanticCustomError("unknown_effect", "unknown effect", {"name": name, "right": right})
    if isinstance(given, EffectParameters):
        return given
    model: type[EffectParameters] = plugins.load_plugin(GROUP, name).Model
    try:
        return model.of(given)  # type: ignore[arg-type]
    except ValidationError as error:
        raise PydanticCustomError("of_an_effect", "wrong", {"name": name, "model": model, "error": error}) from None
