"""The keys of ``[score]``, ``[placement]`` and ``[costs]``: how sites are ranked, and what a plan must meet."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import (
    AfterValidator,
    Field,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from egvs.core import errors, limits, plugins
from egvs.scenario.fields import Name, NotNegative, Point2, Positive, StrictModel, find_duplicates

VehicleClass = Literal[
    "pedestrian", "wheelchair", "bicycle", "scooter", "moped", "motorcycle", "passenger", "private", "hov", "taxi",
    "bus", "coach", "delivery", "truck", "trailer", "evehicle", "emergency", "authority", "army", "vip", "tram",
    "rail_urban", "subway", "rail", "rail_electric", "rail_fast", "ship", "container", "cable_car", "aircraft", "drone",
    "custom1", "custom2",
]  # fmt: skip
"""SUMO's vClasses."""

RankingScore = Literal[
    "egvs", "expected_detections", "seen_well", "points_on_target", "entropy_seen", "coverage", "expected_visibility"
]  # fmt: skip
"""Scores that sites can be ranked by."""

OtherScore = Literal[
    "expected_detections", "noticed", "seen_well", "points_on_target", "entropy_seen", "coverage", "expected_visibility"
]  # fmt: skip
"""Scores besides the EGVS. ``noticed`` ranks no sites: it does not ask how well a box fits."""

SCORES_GROUP = "egvs.scores"
"""Entry points of scores; of those of other packages, a :class:`egvs.scoring.target_scores.VehicleScore` can rank."""


def plugin_scores() -> list[str]:
    """Return the names of the scores that other packages provide, sorted."""
    names = plugins.plugin_names(SCORES_GROUP)
    return [name for name in names if plugins.plugin_package(SCORES_GROUP, name) != plugins.PACKAGE_NAME]


def is_plugin_score(name: str) -> bool:
    """Return whether a score is one that another package provides."""
    return name not in get_args(OtherScore) and name in plugin_scores()


def _check_ranking_score(name: str) -> str:
    """Return the name of a score that can rank sites; ValueError for any other, and for one that is not installed."""
    if name not in (known := [*get_args(RankingScore), *plugin_scores()]):
        problem = f"expected one of {', '.join(known)}, got {name[:80]!r}"
        misspelling = errors.find_misspelling([name], known)
        raise ValueError(f"{problem}; did you mean {misspelling[1]!r}?" if misspelling else problem)
    return name


DEFAULT_SCORE: OtherScore = "expected_detections"
"""The score that the validation study recommends (docs/validity.md), and that new scenarios rank by."""

NOTICED: OtherScore = "noticed"
"""The score that is computed beside :data:`DEFAULT_SCORE`: what people notice, where that is what detectors find."""

VEHICLE_SCORES: tuple[OtherScore, ...] = ("expected_detections", "noticed", "seen_well", "points_on_target")
"""Scores that are means over the vehicles of recorded frames."""


def is_vehicle_score(name: str) -> bool:
    """Return whether a score is a mean over the vehicles of recorded frames, as all plug-in scores that rank are."""
    return name in VEHICLE_SCORES or is_plugin_score(name)


Detector = Literal[
    "cluster", "pointpillars", "pointpillars_sensor", "cluster_uncorrected", "pointpillars_uncorrected"
]  # fmt: skip
"""Detectors whose detections a model of ``expected_detections`` predicts. ``pointpillars_sensor`` has a model, but is
not installed: it measures heights from the sensor and was trained 2 m above the ground, as detectors for cars are."""

UNCORRECTED = "_uncorrected"
"""Ending of the models without the correction for streets."""

FROM_SENSOR: Detector = "pointpillars_sensor"
"""The detector that measures heights from the sensor."""

MEAN_DETECTORS: tuple[Detector, ...] = ("cluster", "pointpillars")
"""The detectors that ``"all"`` stands for; both measure heights from the ground."""

UNCORRECTED_DETECTORS: tuple[Detector, ...] = ("cluster_uncorrected", "pointpillars_uncorrected")
"""The detectors that ``"all_uncorrected"`` stands for."""

DetectorChoice = Literal[Detector, "all_uncorrected", "all"]
"""Values of ``[score] detector``."""

ALL_DETECTORS = "all"
"""Value of ``[score] detector``: the mean over :data:`MEAN_DETECTORS`."""

SCORES_IN_UNITS = ("egvs", "points_on_target")
"""Scores that have a unit; all others are shares."""

DEFAULT_SAMPLED_FRAMES = 250
"""Recorded frames whose vehicles the scores over vehicles use."""

_GAMMA_AT_1_M, _GAMMA_EXPONENT = 10.0, 1.16
"""A fit to the gammas that rank best on the study's training junctions (docs/validity.md, B): 2, 5 and 10 for voxels of
0.25, 0.5 and 1 m; 1, 2 and 5 with moving occlusion. It interpolates three values each, measured with one sensor."""


MIN_GAMMA = 1e-9
"""Smallest gamma above 0."""


def default_gamma(voxel_m: float, *, moving_occlusion: bool) -> float:
    r"""Return the gamma that ``"auto"`` stands for, to two significant digits.

    It is :math:`10 (d / 1 m)^{1.16}` for voxels of d metres, and half of that with moving occlusion.

    Parameters
    ----------
    voxel_m
        Edge length of a voxel.
    moving_occlusion
        Whether vehicles occlude one another.
    """
    gamma = _GAMMA_AT_1_M * voxel_m**_GAMMA_EXPONENT
    if moving_occlusion:
        gamma /= 2
    return float(f"{gamma:.2g}")


def _check_polygon(polygon_m: tuple[Point2, ...]) -> tuple[Point2, ...]:
    """Return the corners of a polygon; ValueError when they are too many or enclose no area."""
    import shapely

    if len(polygon_m) > limits.CORNERS.maximum:
        raise ValueError(f"got {len(polygon_m):,} corners. {limits.CORNERS.hint}")
    reason = shapely.is_valid_reason(shapely.Polygon(polygon_m))
    if reason != "Valid Geometry":
        raise ValueError(f"expected a polygon that encloses an area ({reason})")
    return polygon_m


Corners = Annotated[tuple[Point2, ...], Field(min_length=3), AfterValidator(_check_polygon)]
"""Corners of a polygon in the world frame, in order."""


class ZoneArea(StrictModel):
    """A part of the region: its corners, or a file with its area."""

    polygon_m: Corners | None = Field(None, description="Corners in the world frame, in order; or give file")
    file: str | None = Field(
        None,
        description="GeoJSON, GeoPackage, Shapefile, KML, GeoParquet, or a table with a row per corner. Of a file with "
        "several areas, the zone takes those of its own name",
    )

    @model_validator(mode="after")
    def _check_one_source(self) -> Self:
        if (self.polygon_m is None) == (self.file is None):
            raise ValueError("expected either polygon_m or file")
        return self


class ZoneConfig(ZoneArea):
    """A part of the region in which vehicles have another weight."""

    weight: float = Field(ge=0, description="Weight of vehicles whose centre is in the zone; it is 1 elsewhere")


class WeightsConfig(StrictModel):
    """Weights of vehicles in scores over vehicles: the weight of the kind times those of all zones with its centre."""

    kinds: dict[VehicleClass, Annotated[float, Field(ge=0)]] = Field(
        default_factory=dict,
        description="Weight of each SUMO vClass. By default 1; pedestrians and bicycles of [effects] only count if "
        "they have a weight here, e.g. pedestrian = 2",
    )
    zones: dict[Name, ZoneConfig] = Field(default_factory=dict, description="Parts of the region with other weights")

    @property
    def are_given(self) -> bool:
        """Whether any weight is set."""
        return bool(self.kinds or self.zones)

    @property
    def in_words(self) -> str:
        """Names and weights: "bus 3, zone crosswalk 2"."""
        kinds = [f"{kind} {weight:g}" for kind, weight in self.kinds.items()]
        zones = [f"zone {name} {zone.weight:g}" for name, zone in self.zones.items()]
        return ", ".join([*kinds, *zones])


class ScoreConfig(StrictModel):
    """How sites are scored and ranked."""

    gamma: Annotated[float, Field(ge=0, allow_inf_nan=True)] | Literal["auto"] = Field(
        "auto",
        description="Cap of the beams that count in one voxel: 0, at least 1e-9, or inf. 'auto' depends on the "
        "size of voxels: 10 (voxel_m / 1 m)^1.16 (2 for 0.25 m, 10 for 1 m), and half of that with moving_occlusion",
    )
    rank_by: Annotated[str, AfterValidator(_check_ranking_score)] = Field(
        "egvs",
        description=f"Score that sites are ranked by: {', '.join(get_args(RankingScore))}, or a VehicleScore of an "
        "installed package (docs/extending.md)",
    )
    others: tuple[OtherScore, ...] = Field(
        (DEFAULT_SCORE,), description="Further scores in scores.parquet, besides egvs and the score of rank_by"
    )
    detector: DetectorChoice = Field(
        "all",
        description="Detector that expected_detections, blind spots and zones stand for. 'all' is the mean over "
        "cluster and pointpillars; its standard error contains how far they disagree. pointpillars_sensor measures "
        "heights from the sensor, as detectors for cars do, and misses most from high mounts. _uncorrected are the "
        "models before their correction for streets",
    )
    weights: WeightsConfig = WeightsConfig()
    keep_visibility: tuple[str, ...] | Literal["all"] = Field(
        (), description="Names of sites, or 'all', whose beams in each voxel are written to visibility.parquet"
    )
    blindspots: bool = Field(True, description="Write blindspots.parquet: where each site misses vehicles")
    standard_error: bool = Field(True, description="Estimate the standard errors due to finite traffic")
    sampled_frames: int = Field(
        DEFAULT_SAMPLED_FRAMES,
        ge=1,
        description="Recorded frames, spread evenly, whose vehicles the scores over vehicles and the blind spots use;"
        " at most all. Their cost grows in proportion",
    )
    zones: str | None = Field(
        None,
        description="GeoJSON, GeoPackage, Shapefile, KML, GeoParquet, or a table with a row per corner: named areas, "
        "for which zones.parquet reports the road users found, by class. They change no score",
    )

    @model_serializer(mode="wrap")
    def _serialize(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out keys that are not set, so that they do not change cache keys."""
        unset = {"sampled_frames", "zones", "detector"} - self.model_fields_set
        return {name: value for name, value in serialize(self).items() if name not in unset}

    @field_validator("gamma", mode="before")
    @classmethod
    def _parse_inf(cls, gamma: Any) -> Any:
        """JSON has no infinity: it is written as text."""
        return math.inf if gamma == "inf" else gamma

    @field_validator("gamma")
    @classmethod
    def _check_gamma(cls, gamma: float | str) -> float | str:
        """Squares of scores, which standard errors need, are 0 where all scores are tiny."""
        if isinstance(gamma, float) and 0.0 < gamma < MIN_GAMMA:
            raise ValueError(f"expected 0, or at least {MIN_GAMMA:g}, got {gamma:g}")
        return gamma

    @field_validator("others")
    @classmethod
    def _check_duplicates(cls, others: tuple[OtherScore, ...]) -> tuple[OtherScore, ...]:
        duplicates = find_duplicates(others)
        if duplicates:
            raise ValueError(f"{duplicates[0]} is listed twice")
        return others

    @model_validator(mode="after")
    def _check_sampled_frames(self) -> Self:
        if "sampled_frames" in self.model_fields_set and not self.needs_vehicles:
            scores = ", ".join(VEHICLE_SCORES)
            raise ValueError(
                f"sampled_frames has no effect without blind spots, zones and a score over vehicles ({scores}). "
                "Remove it, or add one of them to others"
            )
        return self

    @model_validator(mode="after")
    def _check_detector(self) -> Self:
        needs_detector = self.blindspots or self.zones is not None or DEFAULT_SCORE in self.additional
        if self.detector != ALL_DETECTORS and not needs_detector:
            raise ValueError(
                f"detector has no effect without {DEFAULT_SCORE}, blind spots and zones. Remove it, or add "
                f"{DEFAULT_SCORE} to others"
            )
        return self

    @property
    def detectors(self) -> tuple[Detector, ...]:
        """The detectors that detection scores average over."""
        if self.detector == "all":
            return MEAN_DETECTORS
        if self.detector == "all_uncorrected":
            return UNCORRECTED_DETECTORS
        return (self.detector,)

    @property
    def ranking_detectors(self) -> tuple[Detector, ...]:
        """The detectors of the score that sites are ranked by; empty for a score without detectors."""
        return self.detectors if self.rank_by == DEFAULT_SCORE else ()

    @property
    def needs_vehicles(self) -> bool:
        """Whether a score, the blind spots or the zones need the vehicles of recorded frames."""
        return self.blindspots or self.zones is not None or any(is_vehicle_score(name) for name in self.additional)

    @property
    def additional(self) -> tuple[str, ...]:
        """The scores to compute besides the EGVS, without duplicates; the one that sites are ranked by is the first.

        :data:`NOTICED` is computed whenever :data:`DEFAULT_SCORE` is.
        """
        names: tuple[str, ...] = self.others
        if self.rank_by != "egvs":
            names = (self.rank_by, *(name for name in self.others if name != self.rank_by))
        if DEFAULT_SCORE in names and NOTICED not in names:
            names += (NOTICED,)
        return names


Share = Annotated[float, Field(gt=0, le=1)]
Turn = Annotated[float, Field(ge=-360, le=360)]
Tilt = Annotated[float, Field(ge=-90, le=90)]


COST_COLUMN = "cost"
"""Column of a sites file with the cost of each candidate."""


class CostsConfig(StrictModel):
    """Costs of a candidate, in any currency. A value in the column ``cost`` of the sites file replaces them."""

    sensor: dict[str, NotNegative] = Field(default_factory=dict, description="Cost of each sensor, by its name")
    pole: NotNegative = Field(0.0, description="Cost of a pole, once for all sensors on it")
    metre: NotNegative = Field(0.0, description="Cost per metre of a sensor's height z_m")

    @property
    def are_given(self) -> bool:
        """Whether any cost is set."""
        return bool(self.sensor or self.pole or self.metre)

    def of_mount(self, sensor: str, z_m: float, *, pole_exists: bool) -> float:
        """Return the cost of a sensor at a height, with its pole; a sensor without a cost of its own counts 0."""
        pole = 0.0 if pole_exists else self.pole
        return self.sensor.get(sensor, 0.0) + pole + self.metre * z_m


class ZoneDemand(ZoneArea):
    """A part of the region that a plan must cover."""

    share: Share = Field(description="Share of the zone's occupancy entropy that must be visible")
    by: int = Field(1, ge=1, description="Number of sensors that must see a voxel for it to count as visible")


class RefinementConfig(StrictModel):
    """How far the sensors of a plan may be moved from the poses of their candidates. Forced sensors are not moved."""

    radius_m: NotNegative | None = Field(
        None,
        description="Horizontal distance by which a pole may be moved, for sites.along along its line. By default half "
        "the spacing for sites.along, else 0",
    )
    within_m: tuple[Corners, ...] = Field(
        (), description="Polygons: a pole inside one may be moved anywhere in it, regardless of radius_m"
    )
    heights_m: tuple[Positive, Positive] | None = Field(
        None, description="Lowest and highest height above the ground. By default those of all candidates"
    )
    yaw_deg: tuple[Turn, Turn] | None = Field(None, description="Lowest and highest yaw. By default any")
    pitch_deg: tuple[Tilt, Tilt] = Field((-30.0, 10.0), description="Lowest and highest pitch, positive for nose up")
    roll_deg: tuple[Tilt, Tilt] | None = Field(
        None,
        description="Lowest and highest roll; from upside down, if the sensor is inverted, as in [sites]. By default "
        "that of the candidate",
    )
    evaluations: int = Field(300, ge=20, description="Number of poses that are tried for a sensor in each round")

    @field_validator("heights_m", "yaw_deg", "pitch_deg", "roll_deg")
    @classmethod
    def _check_ascending(cls, limits: tuple[float, float] | None) -> tuple[float, float] | None:
        if limits is not None and limits[0] > limits[1]:
            raise ValueError(f"expected the lower limit first, got {limits[0]:g} and {limits[1]:g}")
        return limits


class PlacementConfig(StrictModel):
    """What a plan of several sensors must meet. Options of ``egvs place`` override these keys."""

    count: int | None = Field(None, ge=1, description="Maximum number of sensors, including forced ones")
    budget: Positive | None = Field(None, description="Maximum cost, see [costs]; forced candidates are free")
    reach: Share | None = Field(
        None, description="Find the fewest sensors that reach this share of the score of all candidates together"
    )
    forced: tuple[str, ...] = Field(
        (), description="Candidates, or poles with one, that exist already and are part of every plan"
    )
    excluded: tuple[str, ...] = Field((), description="Candidates or poles that must not be used")
    most_per_pole: int | None = Field(None, ge=1, description="Maximum number of sensors on a pole. By default any")
    least_distance_m: NotNegative = Field(0.0, description="Minimum distance between any two sensors")
    zones: dict[Name, ZoneDemand] = Field(default_factory=dict, description="Parts of the region to cover, by name")
    objective: Literal["mean", "worst"] = Field(
        "mean",
        description="For traffic with periods: 'mean' maximises the score of their mix, 'worst' that of the period "
        "with the smallest share of the score of all candidates together",
    )
    periods: tuple[str, ...] = Field((), description='Periods that objective = "worst" considers. By default all')
    survives: int = Field(
        0, ge=0, le=1, description="1: maximise the score that remains when the most important sensor fails"
    )
    refine: RefinementConfig | None = Field(
        None, description="Move the sensors of the plan, as with --refine, within the limits of this table"
    )

    @model_validator(mode="after")
    def _check_names(self) -> PlacementConfig:
        for key in ("forced", "excluded", "periods"):
            duplicates = find_duplicates(getattr(self, key))
            if duplicates:
                raise ValueError(f"{key} lists {duplicates[0]} twice")
        for name in self.forced:
            if name in self.excluded:
                raise ValueError(f"{name} is both forced and excluded")
        if self.survives and self.count is not None and self.count < 2:
            raise ValueError("survives = 1 needs a count above 1: nothing remains when the only sensor fails")
        return self
