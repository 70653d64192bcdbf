"""The keys of ``[traffic]``: where vehicles come from, how many, how long they are watched."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from egvs.scenario.fields import Name, Positive, StrictModel

_ATTRIBUTE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9]*")
"""What an attribute of a vType may be called: it is written into XML as it stands."""


class VehicleKind(StrictModel):
    """One row of the fleet: a SUMO vType with its real size and its share of the trips."""

    name: Name = Field(description="Identifier of the SUMO vType; for a finished FCD file, the type that it names")
    vclass: str = Field("passenger", description="SUMO vClass")
    share: Positive = Field(1.0, description="Share of the trips, relative to the other kinds")
    length_m: Positive
    width_m: Positive
    height_m: Positive
    attributes: dict[str, str | float] = Field(
        default_factory=dict, description="Further attributes of the SUMO vType, under SUMO's own names"
    )

    @field_validator("attributes")
    @classmethod
    def _named_as_in_sumo(cls, attributes: dict[str, str | float]) -> dict[str, str | float]:
        for name in attributes:
            if _ATTRIBUTE_NAME.fullmatch(name) is None:
                raise ValueError(f"{name[:80]!r} is no attribute's name: letters and digits, as in SUMO's sigma")
        return attributes


EdgeId = Annotated[str, Field(min_length=1)]


class CountConfig(StrictModel):
    """Vehicles an hour that were counted on an edge, or on their way from one edge to another."""

    edge: EdgeId | None = Field(None, description="Id of an edge of the network; or from_edge and to_edge")
    from_edge: EdgeId | None = Field(None, description="Id of the edge from which vehicles were counted")
    to_edge: EdgeId | None = Field(
        None, description="Id of the edge to which they drove, at the next junction or beyond"
    )
    per_hour: float = Field(ge=0, le=1e5, description="Vehicles an hour")
    kind: str = Field("", description="The kind counted; not given: the whole fleet, its kinds by their shares")

    @model_validator(mode="after")
    def _check_location(self) -> CountConfig:
        given = tuple(key is not None for key in (self.edge, self.from_edge, self.to_edge))
        if given not in ((True, False, False), (False, True, True)):
            raise ValueError("either edge, or both from_edge and to_edge are needed")
        if self.edge is None and self.from_edge == self.to_edge:
            raise ValueError(f"from_edge and to_edge are both {self.from_edge!r}")
        return self

    @property
    def title(self) -> str:
        """The counted place in words."""
        return self.edge or f"{self.from_edge} to {self.to_edge}"


class PeriodConfig(StrictModel):
    """A part of the day with traffic of its own; a key that is not given is that of ``[traffic]``."""

    name: Name = Field(description="Shown in results: morning, midday, evening, night")
    weight: Positive = Field(1.0, description="Share of the mix, relative to the other periods: its hours, for example")
    sumocfg: str | None = Field(None, description="Its own .sumocfg")
    fcd: str | None = Field(None, description="Its own finished FCD file")
    routes: tuple[str, ...] = Field((), description="Its own route files for the network")
    counts: tuple[CountConfig, ...] = Field((), description="Its own counted vehicles")
    vehicles: int | None = Field(None, ge=1, description="Its own number of vehicles at all times")
    begin_s: float | None = Field(None, ge=0, description="As traffic.begin_s")
    length_s: Positive | None = Field(None, description="Time recorded, instead of traffic.frames")

    @model_validator(mode="after")
    def _one_source(self) -> PeriodConfig:
        if self.sumocfg is not None and self.fcd is not None:
            raise ValueError("sumocfg and fcd: a period has one source")
        return self

    def over(self, traffic: TrafficConfig) -> TrafficConfig:
        """The traffic of this period alone; ValueError where the keys do not go together."""
        values = {key: getattr(traffic, key) for key in traffic.model_fields_set - {"periods"}}
        if source := next((key for key in ("sumocfg", "fcd") if getattr(self, key) is not None), None):
            for key in (*TRAFFIC_SOURCES, "routes", "counts"):
                values.pop(key, None)
            values[source] = getattr(self, source)
        own = {key: getattr(self, key) for key in ("routes", "counts", "vehicles", "begin_s")}
        values |= {key: value for key, value in own.items() if value is not None and value != ()}
        for given, other in (("routes", "counts"), ("counts", "routes")):
            if own[given] and not own[other]:
                values.pop(other, None)
        if self.length_s is not None:
            exact = self.length_s / traffic.frame_period_s
            if abs(exact - round(exact)) > 1e-9 * exact:
                period = f"{traffic.frame_period_s:g} s"
                raise ValueError(f"period {self.name!r}: length_s = {self.length_s:g} is no whole number of {period}")
            values["frames"] = round(exact)
        try:
            return TrafficConfig(**values)
        except ValidationError as error:
            raise ValueError(f"period {self.name!r}: {error.errors()[0]['msg']}") from None


_DEFAULT_FLEET = (
    VehicleKind(name="car", share=0.78, length_m=4.5, width_m=1.75, height_m=1.5),
    VehicleKind(name="van", vclass="delivery", share=0.12, length_m=4.9, width_m=1.9, height_m=2.1),
    VehicleKind(name="truck", vclass="truck", share=0.07, length_m=7.6, width_m=2.3, height_m=3.0),
    VehicleKind(name="bus", vclass="bus", share=0.03, length_m=10.9, width_m=2.5, height_m=3.1),
)

DEFAULT_FRAMES, DEFAULT_WARMUP_S = 5000, 300.0
"""What is recorded where a scenario does not say it, and the time before; a finished file is taken whole."""


def _is_finished(given: dict[str, Any]) -> bool:
    """Whether the traffic of these keys comes from a finished file."""
    return given.get("fcd") is not None


def _of_first_period(given: dict[str, Any], key: str) -> str | None:
    """Where each period has its own source and ``[traffic]`` none, the first one's stands for what all share."""
    periods = given.get("periods")
    if not periods or any(given.get(source) is not None for source in ("network", "sumocfg")):
        return None
    source: str | None = getattr(periods[0], key)
    return source


TRAFFIC_SOURCES = ("network", "sumocfg", "fcd")
"""Keys that say where vehicles come from; a scenario has one of them."""

_RATE_KEYS = frozenset({"vehicles_per_lane_km", "trips_per_s", "min_trip_m"})
"""Keys that say how many trips are drawn where none were counted."""


def unused_keys(source: str) -> frozenset[str]:
    """The keys that act on nothing with this source: one of :data:`TRAFFIC_SOURCES`, or "routes" for a network with
    routes."""
    drawn = _RATE_KEYS | {"counts", "edge_weights", "kinds"}
    simulated = frozenset({"vehicles", "hold", "step_s", "lateral_resolution_m", "max_depart_delay_s"})
    if source == "fcd":
        return simulated | drawn - {"kinds"} | {"routes"}
    return {"sumocfg": drawn | {"routes"}, "routes": drawn}.get(source, frozenset()) | {"vtypes", "roads", "fcd_geo"}


class TrafficConfig(StrictModel):
    """Where vehicles come from: a network (with drawn or given demand), a SUMO configuration, or a finished FCD
    file.
    """

    network: str | None = Field(
        None, description="A .net.xml(.gz) or an OpenStreetMap file; may start with $SUMO_HOME/"
    )
    periods: tuple[PeriodConfig, ...] = Field(
        (), description="Parts of the day with traffic of their own, mixed by weight; scores are told for each, too"
    )
    routes: tuple[str, ...] = Field(
        (), description="Route files for the network; none: trips are drawn between its fringe edges"
    )
    sumocfg: str | None = Field(
        default_factory=lambda given: _of_first_period(given, "sumocfg"),
        description="A .sumocfg that names network and demand",
    )
    fcd: str | None = Field(
        default_factory=lambda given: _of_first_period(given, "fcd"),
        description="A finished FCD file (XML, CSV or Parquet, may be gzipped); nothing is simulated",
    )
    fcd_geo: bool = Field(
        False, description="Whether x and y of finished FCD files are longitude and latitude (SUMO's --fcd-output.geo)"
    )
    roads: str | None = Field(
        None,
        description="The network on which the vehicles of a finished FCD file drove (as `network`): maps show it, blind"
        " spots name its lanes, checks hold sites against it",
    )
    vtypes: tuple[str, ...] = Field(
        (), description="SUMO files with <vType>s: the sizes in a finished FCD file; kinds come before them"
    )
    vehicles: int | None = Field(
        None,
        ge=1,
        description="Vehicles in the whole network at all times; not given, routes and a sumocfg are taken as they are"
        " and drawn trips follow vehicles_per_lane_km",
    )
    vehicles_per_lane_km: Positive = Field(
        4.0, description="Drawn trips where vehicles is not given: vehicles for each km of lanes that the fleet may use"
    )
    hold: Literal["exactly", "at_most"] = Field(
        "exactly", description="Whether a frame with fewer vehicles than are to be held is an error"
    )
    frames: int | None = Field(
        default_factory=lambda given: None if _is_finished(given) else DEFAULT_FRAMES,
        ge=1,
        le=2**32 - 1,
        description=f"Frames to record; {DEFAULT_FRAMES} if not given, of a finished file all",
    )
    frame_period_s: Positive = Field(1.0, description="Time between two frames; a whole number of steps")
    begin_s: float | None = Field(
        None,
        ge=0,
        description="The simulation's clock when it begins, warmup_s before the first frame; not given, that of the"
        " sumocfg, or 0. Of a finished file: seconds of it that are left out before the warm-up",
    )
    step_s: Positive = Field(0.25, description="SUMO's step length")
    warmup_s: float = Field(
        default_factory=lambda given: 0.0 if _is_finished(given) else DEFAULT_WARMUP_S,
        ge=0,
        description=f"Time before the first frame; {DEFAULT_WARMUP_S:g} if not given, of a finished file 0",
    )
    lateral_resolution_m: float = Field(
        0.8, ge=0, description="SUMO's sublane width; 0 makes lane changes instant jumps"
    )
    trips_per_s: Positive = Field(
        2.0, description="Rate of drawn trips; more than the network takes, so that N is held"
    )
    max_depart_delay_s: Positive | None = Field(
        None,
        description="A trip that could not start for so long is given up; not given, drawn trips are after 120 s and a"
        " demand of your own never",
    )
    min_trip_m: float = Field(0.0, ge=0, description="Drawn trips are at least so long as the crow flies")
    edge_weights: dict[str, Annotated[float, Field(ge=0)]] = Field(
        default_factory=dict,
        description="Drawn trips that start or end at an edge, relative to others; its number of lanes if not named",
    )
    counts: tuple[CountConfig, ...] = Field(
        (), description="Counted vehicles; not given: trips are drawn between the network's fringe edges"
    )
    kinds: tuple[VehicleKind, ...] = Field(
        _DEFAULT_FLEET, min_length=1, description="The fleet of drawn trips; the sizes in a finished FCD file"
    )

    @model_validator(mode="after")
    def _periods(self) -> TrafficConfig:
        names = [period.name.casefold() for period in self.periods]  # folders that some systems do not tell apart
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"two periods have the same name: {', '.join(twice)}")
        for period in self.periods:
            period.over(self)
        return self

    @model_validator(mode="after")
    def _one_source(self) -> TrafficConfig:
        given = [key for key in TRAFFIC_SOURCES if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(
                f"exactly one of network, sumocfg and fcd is needed, found {' and '.join(given) or 'none'}"
            )
        names = [kind.name for kind in self.kinds]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"two kinds have the same name: {', '.join(twice)}")
        return self

    @model_validator(mode="after")
    def _counted_once(self) -> TrafficConfig:
        places = [(count.title, count.kind) for count in self.counts]
        if twice := sorted({place for place in places if places.count(place) > 1}):
            told = ", ".join(f"{place} ({kind})" if kind else place for place, kind in twice)
            raise ValueError(f"counts: given twice for {told}; one for each place and kind")
        if self.counts and not any(count.per_hour for count in self.counts):
            raise ValueError("counts: no vehicle was counted anywhere; at least one per_hour above 0")
        return self

    @model_validator(mode="after")
    def _not_endless(self) -> TrafficConfig:
        frames = self.frames or 0
        lasts_s = self.warmup_s + frames * self.frame_period_s
        counted_per_s = sum(count.per_hour for count in self.counts) / 3600.0
        for what, amount, most in (
            ("frames", frames, 10_000_000),
            ("seconds of traffic", lasts_s, 1e7),
            ("drawn trips (trips_per_s times these seconds)", lasts_s * self.trips_per_s, 1e7),
            ("counted vehicles (per_hour for all this time)", lasts_s * counted_per_s, 1e7),
        ):
            if amount > most:
                raise ValueError(f"{amount:,.0f} {what}: at most {most:,.0f} can be handled")
        return self

    @property
    def named_kinds(self) -> tuple[VehicleKind, ...]:
        """The kinds that the scenario itself names."""
        return self.kinds if self.kinds != _DEFAULT_FLEET else ()

    def unused_keys(self) -> Iterator[tuple[str, str, set[str]]]:
        """Tables with keys that the user set although they act on nothing: the table, the source of its traffic, the
        keys. A key of ``[traffic]`` acts if it does in any period."""
        alone = [period.over(self) for period in self.periods] or [self]
        found = [traffic._unused() for traffic in alone]
        if everywhere := set.intersection(*(idle for _, idle in found)) & self.model_fields_set:
            yield "traffic", found[0][0], everywhere
        for period, (source, idle) in zip(self.periods, found, strict=False):
            if own := idle & period.model_fields_set:
                yield f"traffic.periods ({period.name})", source, own

    def _unused(self) -> tuple[str, set[str]]:
        """The source of the traffic, and the keys that act on nothing with this source."""
        source = next(key for key in TRAFFIC_SOURCES if getattr(self, key) is not None)
        if self.routes and source == "network":
            source = "routes"
        if idle := self.model_fields_set & unused_keys(source):
            return source, set(idle)
        if self.counts and (idle := self.model_fields_set & _RATE_KEYS):
            return "counts", idle
        return "vehicles", self.model_fields_set & ({"vehicles_per_lane_km"} if self.vehicles is not None else set())
