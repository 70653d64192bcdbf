"""The keys of ``[traffic]``: where vehicles come from, how many there are, and how long they are recorded."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    field_validator,
    model_serializer,
    model_validator,
)

from egvs.scenario.fields import Name, Positive, StrictModel, find_duplicates
from egvs.scenario.signal_config import SignalConfig
from egvs.scenario.track_columns import TrackColumns

_ATTRIBUTE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9]*")
"""Names of attributes of a vType, which are written into XML unchanged."""


class VehicleKind(StrictModel):
    """A kind of vehicle in the fleet: a SUMO vType with its size and its share of the trips."""

    name: Name = Field(description="Id of the SUMO vType; with a finished FCD file, the type that the file names")
    vclass: str = Field("passenger", description="SUMO vClass")
    share: Positive = Field(1.0, description="Share of the trips, relative to the other kinds")
    length_m: Positive = Field(description="Length of the vehicle")
    width_m: Positive = Field(description="Width of the vehicle")
    height_m: Positive = Field(description="Height of the vehicle")
    attributes: dict[str, str | float] = Field(
        default_factory=dict, description="Further attributes of the SUMO vType, by SUMO's names"
    )

    @field_validator("vclass")
    @classmethod
    def _check_vclass(cls, vclass: str) -> str:
        if re.fullmatch("[a-z0-9_]{1,40}", vclass) is None:
            raise ValueError(f"expected a vClass of SUMO, such as passenger or bus, got {vclass[:80]!r}")
        return vclass

    @field_validator("attributes")
    @classmethod
    def _check_attribute_names(cls, attributes: dict[str, str | float]) -> dict[str, str | float]:
        for name in attributes:
            if _ATTRIBUTE_NAME.fullmatch(name) is None:
                raise ValueError(f"expected a name of letters and digits, such as sigma, got {name[:80]!r}")
        return attributes


COUNT_IDS, COUNT_NAMES = ("edge", "from_edge", "to_edge"), ("approach", "turn", "to")
"""Columns of a table of counts: ids of edges, and names that are only for people."""

MAX_PER_HOUR = 1e5

EdgeId = Annotated[str, Field(min_length=1)]

Step = Annotated[float, Field(ge=1e-3)]
"""Seconds; SUMO counts in milliseconds."""


class CountConfig(StrictModel):
    """A traffic count: vehicles per hour on an edge, or from one edge to another."""

    edge: EdgeId | None = Field(None, description="Id of an edge of the network; or set from_edge and to_edge")
    from_edge: EdgeId | None = Field(None, description="Id of the edge that the counted vehicles came from")
    to_edge: EdgeId | None = Field(
        None, description="Id of the edge that they drove to, at the next junction or beyond"
    )
    per_hour: float = Field(ge=0, le=MAX_PER_HOUR, description="Vehicles per hour")
    kind: str = Field("", description="Kind of vehicle that was counted. By default the whole fleet")

    @model_validator(mode="after")
    def _check_location(self) -> CountConfig:
        is_set = tuple(edge is not None for edge in (self.edge, self.from_edge, self.to_edge))
        if is_set not in ((True, False, False), (False, True, True)):
            raise ValueError("expected either edge, or both from_edge and to_edge")
        if self.edge is None and self.from_edge == self.to_edge:
            raise ValueError(f"from_edge and to_edge are both {self.from_edge!r}")
        return self

    @property
    def title(self) -> str:
        """The counted location: "edge" or "edge to edge"."""
        return self.edge or f"{self.from_edge} to {self.to_edge}"


_PERIOD_SOURCES = ("sumocfg", "fcd", "tracks")
"""Sources of traffic that a period may have of its own."""

Tracks = Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=1)]


def _allow_table(schema: dict[str, Any]) -> None:
    schema["type"] = ["array", "string"]


Counts = Annotated[tuple[CountConfig, ...], Field(json_schema_extra=_allow_table)]
"""A scenario file may name a CSV table instead of the rows, which is read with it."""


class PeriodConfig(StrictModel):
    """A part of the day with traffic of its own. Keys that are not set are those of ``[traffic]``."""

    name: Name = Field(description="Name in results, e.g. morning, midday, evening or night")
    weight: Positive = Field(1.0, description="Share of the mix, relative to the other periods, e.g. hours")
    sumocfg: str | None = Field(None, description="SUMO configuration of this period")
    fcd: str | None = Field(None, description="Finished FCD file of this period")
    tracks: Tracks | None = Field(None, description="Files of recorded tracks of this period")
    routes: tuple[str, ...] = Field((), description="Route files of this period")
    counts: Counts = Field((), description="Traffic counts of this period, in rows or in a CSV table")
    vehicles: int | None = Field(None, ge=1, description="Number of vehicles in the network in this period")
    begin_s: float | None = Field(None, ge=0, description="As traffic.begin_s")
    length_s: Positive | None = Field(None, description="Duration of the recording, instead of traffic.frames")

    @model_validator(mode="after")
    def _check_source(self) -> PeriodConfig:
        sources = [key for key in _PERIOD_SOURCES if getattr(self, key) is not None]
        if len(sources) > 1:
            raise ValueError(f"expected one of {', '.join(_PERIOD_SOURCES)}, got {' and '.join(sources)}")
        return self

    def apply_to(self, traffic: TrafficConfig) -> TrafficConfig:
        """Return the traffic of this period.

        Parameters
        ----------
        traffic
            The complete traffic.

        Raises
        ------
        ValueError
            When the keys contradict each other.
        """
        values = {key: getattr(traffic, key) for key in traffic.model_fields_set - {"periods"}}
        for source in _PERIOD_SOURCES:
            if getattr(self, source) is not None:
                for key in (*TRAFFIC_SOURCES, "routes", "counts"):
                    values.pop(key, None)
                values[source] = getattr(self, source)
        own = {key: getattr(self, key) for key in ("routes", "counts", "vehicles", "begin_s")}
        values |= {key: value for key, value in own.items() if value not in (None, ())}
        if self.routes and not self.counts:
            values.pop("counts", None)
        if self.counts and not self.routes:
            values.pop("routes", None)
        if self.length_s is not None:
            frames = self.length_s / traffic.frame_period_s
            if abs(frames - round(frames)) > 1e-9 * frames:
                multiple = f"a multiple of {traffic.frame_period_s:g} s"
                raise ValueError(f"period {self.name!r}: length_s = {self.length_s:g} is not {multiple}")
            values["frames"] = round(frames)
        try:
            return TrafficConfig(**values)
        except ValidationError as error:
            raise ValueError(
                f"period {self.name!r}: {error.errors()[0]['msg'].removeprefix('Value error, ')}"
            ) from None


_DEFAULT_FLEET = (
    VehicleKind(name="car", share=0.78, length_m=4.5, width_m=1.75, height_m=1.5),
    VehicleKind(name="van", vclass="delivery", share=0.12, length_m=4.9, width_m=1.9, height_m=2.1),
    VehicleKind(name="truck", vclass="truck", share=0.07, length_m=7.6, width_m=2.3, height_m=3.0),
    VehicleKind(name="bus", vclass="bus", share=0.03, length_m=10.9, width_m=2.5, height_m=3.1),
)

DEFAULT_FRAMES, DEFAULT_WARMUP_S = 5000, 300.0
"""Defaults of simulated traffic; a finished file is used completely."""


def _is_finished(values: dict[str, Any]) -> bool:
    """Return whether the traffic was recorded, so that nothing is simulated; ``values`` are the keys before
    ``frames``.
    """
    return any(values.get(key) is not None for key in FINISHED_SOURCES)


def _first_source(values: dict[str, Any], key: str) -> Any:
    """Return the source of the first period, where ``[traffic]`` has none: it serves for what all periods share."""
    periods = values.get("periods")
    if not periods or any(values.get(source) is not None for source in TRAFFIC_SOURCES):
        return None
    return getattr(periods[0], key)


TRAFFIC_SOURCES = ("network", "sumocfg", "fcd", "tracks")
"""Keys that set where vehicles come from; exactly one must be set."""

FINISHED_SOURCES = ("fcd", "tracks")
"""Those of them with which nothing is simulated."""

_RANDOM_TRIP_KEYS = frozenset({
    "vehicles_per_lane_km", "vehicles_per_h", "trips_per_s", "min_trip_m", "reroute_at_departure",
})  # fmt: skip
"""Keys for random trips, which have no effect with counts."""

_HELD_NUMBER_KEYS = frozenset({"vehicles_per_lane_km", "trips_per_s", "hold"})
"""Keys that maintain a number of vehicles, which have no effect with ``vehicles_per_h``."""


_TRACK_KEYS = frozenset({"track_gap_s", "track_columns", "track_crs"})
"""Keys that say how recorded tracks are read."""


class UnusedKeys(NamedTuple):
    """Keys that are set although they have no effect.

    Attributes
    ----------
    table
        The table with the keys.
    source
        Key that makes them unused, e.g. "fcd".
    keys
        The keys.
    """

    table: str
    source: str
    keys: set[str]


def keys_without_effect(source: str) -> frozenset[str]:
    """Return the keys that have no effect with a source of traffic.

    Parameters
    ----------
    source
        One of :data:`TRAFFIC_SOURCES`, or "routes" for a network with routes.
    """
    demand = _RANDOM_TRIP_KEYS | {"counts", "edge_weights", "kinds", "observed"}
    simulation = frozenset({
        "vehicles", "hold", "step_s", "lateral_resolution_m", "max_depart_delay_s", "junction_blocker_s", "teleport_s",
    })  # fmt: skip
    for_fcd = frozenset({"vtypes", "fcd_geo"})
    for_tracks = _TRACK_KEYS | {"coverage"}
    if source in FINISHED_SOURCES:
        simulation |= {"pedestrian_tracks", "signals"}
        unused = simulation | demand - {"kinds"} | {"routes", "redraw_departures"}
        return unused | (for_tracks if source == "fcd" else for_fcd)
    unused = for_fcd | for_tracks | {"roads"}
    if source == "network":
        return unused | {"redraw_departures"}
    return unused | demand | ({"routes"} if source == "sumocfg" else set())


class TrafficConfig(StrictModel):
    """Where vehicles come from: a network (with random or given demand), a SUMO configuration, a finished FCD file, or
    recorded tracks.
    """

    network: str | None = Field(None, description="SUMO network (.net.xml, .net.xml.gz); may start with $SUMO_HOME/")
    periods: tuple[PeriodConfig, ...] = Field(
        (), description="Parts of the day with traffic of their own, mixed by their weights and scored one by one"
    )
    routes: tuple[str, ...] = Field(
        (), description="Route files for the network. By default, random trips are drawn between its fringe edges"
    )
    sumocfg: str | None = Field(
        default_factory=lambda values: _first_source(values, "sumocfg"),
        description="SUMO configuration (.sumocfg) that names network and demand",
    )
    fcd: str | None = Field(
        default_factory=lambda values: _first_source(values, "fcd"),
        description="Finished FCD file (XML, CSV or Parquet, may be gzipped); nothing is simulated",
    )
    fcd_geo: bool = Field(
        False, description="x and y of the finished FCD file are longitude and latitude (SUMO's --fcd-output.geo)"
    )
    tracks: Tracks | None = Field(
        default_factory=lambda values: _first_source(values, "tracks"),
        description="Files of recorded tracks (see docs/tracks.md), all on one clock; nothing is simulated",
    )
    pedestrian_tracks: Tracks | None = Field(
        None, description="Files of recorded pedestrians and bicycles, beside simulated vehicles"
    )
    track_gap_s: Positive = Field(
        2.0, description="Longest gap in a recorded track that is interpolated. In longer ones its position is unknown"
    )
    track_columns: TrackColumns | None = Field(
        None, description="Meaning of the columns of recorded tracks in a table of your own (CSV or JSON lines)"
    )
    track_crs: str | None = Field(
        None,
        min_length=1,
        description="Coordinate system of recorded tracks, instead of the one of their format: a name that PROJ knows,"
        ' or "world" for metres of the network',
    )
    coverage: str | None = Field(
        None,
        description="GeoJSON file with the area that the recording could see; boxes outside are left out. By default it"
        " is estimated from the tracks, and only reported",
    )
    roads: str | None = Field(
        None,
        description="Network (as in `network`) on which the vehicles of a finished FCD file or of recorded tracks"
        " drove. It is shown on maps, names lanes with blind spots, and is used to check sites and positions",
    )
    vtypes: tuple[str, ...] = Field(
        (), description="SUMO files with <vType>s: sizes of vehicles in a finished FCD file; `kinds` override them"
    )
    vehicles: int | None = Field(
        None,
        ge=1,
        description="Number of vehicles in the network at all times. By default, demand is used unchanged and random "
        "trips follow vehicles_per_lane_km",
    )
    vehicles_per_lane_km: Positive = Field(
        4.0, description="Vehicles per km of lanes that the fleet may use, for random trips when vehicles is not set"
    )
    vehicles_per_h: Positive | None = Field(
        None,
        description="Vehicles that start per hour, as random trips at regular intervals, instead of a number of"
        " vehicles in the network. Half of the trip ends are at the fringe, the others along streets. Use it for whole"
        " towns: it does not fill them",
    )
    hold: Literal["exactly", "at_most"] = Field(
        "exactly", description="'exactly': a frame with fewer than `vehicles` is an error; 'at_most': it is allowed"
    )
    frames: int | None = Field(
        default_factory=lambda values: None if _is_finished(values) else DEFAULT_FRAMES,
        ge=1,
        le=2**32 - 1,
        description=f"Number of recorded frames. By default {DEFAULT_FRAMES}, or all of a finished file",
    )
    seeds: int = Field(
        1,
        ge=1,
        le=1000,
        description="Number of independent simulations that share `frames` equally, each with a warm-up and a seed of"
        " its own; the first has the scenario's seed. From 2 on, standard errors come from the differences between"
        " them. It must divide tpog.blocks",
    )
    frame_period_s: Step = Field(1.0, description="Time between two frames; a multiple of step_s")
    begin_s: float | None = Field(
        None,
        ge=0,
        description="Simulation time at the beginning, warmup_s before the first frame. By default that of the sumocfg,"
        " or 0. For a finished file: seconds of it that are skipped before the warm-up",
    )
    step_s: Step = Field(0.25, description="SUMO's step length")
    warmup_s: float = Field(
        default_factory=lambda values: 0.0 if _is_finished(values) else DEFAULT_WARMUP_S,
        ge=0,
        description=f"Time before the first frame. By default {DEFAULT_WARMUP_S:g}, or 0 for a finished file",
    )
    lateral_resolution_m: float = Field(
        0.8, ge=0, description="Width of SUMO's sublanes; 0 makes lane changes instantaneous"
    )
    junction_blocker_s: Positive | None = Field(
        None,
        description="Time after which a vehicle drives on through another one that blocks it on a junction (SUMO's"
        " --ignore-junction-blocker). It ends locks, and overlaps are counted. By default never",
    )
    teleport_s: Positive | None = Field(
        None,
        description="Time after which a vehicle that stands first on its lane is moved to the next free place on its"
        " route (SUMO's --time-to-teleport), or longer where a signal is red for longer. It is the last resort against"
        " locks, and is counted. By default never",
    )
    trips_per_s: Positive = Field(
        2.0, description="Rate of random trips; higher than the network can take, so that `vehicles` is maintained"
    )
    max_depart_delay_s: Positive | None = Field(
        None,
        description="Time after which a trip that cannot depart is discarded. By default 120 s for random trips, and"
        " never for your own demand",
    )
    reroute_at_departure: bool = Field(
        False,
        description="Random trips take the route that is fastest in the traffic at their departure, rather than on"
        " empty streets (SUMO's device.rerouting)",
    )
    redraw_departures: bool = Field(
        False,
        description="Vehicles of your own demand depart at random times within the same five minutes, and flows at"
        " random intervals, so that another seed gives other traffic. By default as in the files",
    )
    min_trip_m: float = Field(0.0, ge=0, description="Minimum straight-line distance of random trips")
    edge_weights: dict[str, Annotated[float, Field(ge=0)]] = Field(
        default_factory=dict,
        description="Weight of an edge (id) as start or end of random trips. By default its number of lanes",
    )
    signals: dict[str, SignalConfig] = Field(
        default_factory=dict,
        description="Plans of traffic signals, by the id of the signal or junction, or its street names with '/'"
        " between them. By default, those of the network",
    )
    counts: Counts = Field(
        (),
        description="Traffic counts: rows, or the name of a CSV table with the columns from_edge and to_edge, or edge,"
        " and count. By default, random trips are drawn between the network's fringe edges",
    )
    observed: str | None = Field(
        None,
        min_length=1,
        description="Table with queues and speeds that were observed on approaches (columns approach or street, or"
        " both, and queue_m or speed_kmh, or both; period where there are periods), to compare with the simulated ones",
    )
    kinds: tuple[VehicleKind, ...] = Field(
        _DEFAULT_FLEET,
        min_length=1,
        description="The fleet of random trips; sizes of vehicles in a finished FCD file or, by class, in recorded"
        " tracks without sizes",
    )

    @model_serializer(mode="wrap")
    def _serialize(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out keys that have their defaults and are rarely set, so that they do not change cache keys."""
        optional = {"seeds": 1, "signals": {}}
        return {
            name: value for name, value in serialize(self).items() if name not in optional or value != optional[name]
        }

    @model_validator(mode="after")
    def _check_periods(self) -> TrafficConfig:
        # names become folders, and some file systems ignore case
        duplicates = find_duplicates([period.name.casefold() for period in self.periods])
        if duplicates:
            raise ValueError(f"two periods have the same name: {', '.join(duplicates)}")
        for period in self.periods:
            period.apply_to(self)
        return self

    @model_validator(mode="after")
    def _check_source(self) -> TrafficConfig:
        # defaults know the keys before their own only, so a later source of [traffic] outranks them here
        if any(getattr(self, key) is not None for key in self.model_fields_set.intersection(TRAFFIC_SOURCES)):
            for key in set(_PERIOD_SOURCES) - self.model_fields_set:
                self.__dict__[key] = None
        sources = [key for key in TRAFFIC_SOURCES if getattr(self, key) is not None]
        if len(sources) != 1:
            actual = " and ".join(sources) or "none"
            raise ValueError(f"expected exactly one of network, sumocfg, fcd and tracks, got {actual}")
        if self.track_crs is not None and self.track_columns is not None and self.track_columns.crs is not None:
            raise ValueError("expected track_crs or track_columns.crs, got both")
        duplicates = find_duplicates([kind.name for kind in self.kinds])
        if duplicates:
            raise ValueError(f"two kinds have the same name: {', '.join(duplicates)}")
        if self.seeds > 1 and self.is_finished:
            raise ValueError(
                f"seeds: expected 1 with {sources[0]}, because nothing is simulated, got {self.seeds}. Remove seeds"
            )
        return self

    @model_validator(mode="after")
    def _check_counts(self) -> TrafficConfig:
        duplicates = find_duplicates([(count.title, count.kind) for count in self.counts])
        if duplicates:
            names = ", ".join(f"{title} ({kind})" if kind else title for title, kind in duplicates)
            raise ValueError(f"counts: expected one count for each location and kind, got two for {names}")
        if self.counts and not any(count.per_hour for count in self.counts):
            raise ValueError("counts: expected at least one count with per_hour above 0")
        return self

    @model_validator(mode="after")
    def _check_amounts(self) -> TrafficConfig:
        frames = self.frames or 0
        duration_s = self.seeds * self.warmup_s + frames * self.frame_period_s
        counted_per_s = sum(count.per_hour for count in self.counts) / 3600.0
        trips_per_s = self.trips_per_s
        if self.vehicles_per_h is not None:
            trips_per_s = self.vehicles_per_h / 3600.0
        for what, amount, maximum in (
            ("frames", frames, 10_000_000),
            ("seconds of traffic", duration_s, 1e7),
            ("random trips (their rate times these seconds)", duration_s * trips_per_s, 1e7),
            ("counted vehicles (per_hour for all this time)", duration_s * counted_per_s, 1e7),
        ):
            if amount > maximum:
                raise ValueError(f"expected at most {maximum:,.0f} {what}, got {amount:,.0f}")
        return self

    @property
    def is_finished(self) -> bool:
        """Whether the traffic was recorded or simulated before, so that nothing is simulated."""
        return any(getattr(self, key) is not None for key in FINISHED_SOURCES)

    @property
    def has_user_demand(self) -> bool:
        """Whether SUMO simulates demand files of the user."""
        return self.sumocfg is not None or bool(self.routes)

    @property
    def named_kinds(self) -> tuple[VehicleKind, ...]:
        """The kinds that the scenario sets; none for the default fleet."""
        return () if self.kinds == _DEFAULT_FLEET else self.kinds

    def unused_keys(self) -> Iterator[UnusedKeys]:
        """Yield keys that the user set although they have no effect.

        A key of ``[traffic]`` has an effect if it has one in any period.
        """
        unused = [traffic._unused_keys() for traffic in [period.apply_to(self) for period in self.periods] or [self]]
        everywhere = set.intersection(*(item.keys for item in unused)) & self.model_fields_set
        if everywhere:
            yield UnusedKeys("traffic", unused[0].source, everywhere)
        for period, in_period in zip(self.periods, unused, strict=False):
            keys = in_period.keys & period.model_fields_set
            if keys:
                yield UnusedKeys(f"traffic.periods ({period.name})", in_period.source, keys)

    def _unused_keys(self) -> UnusedKeys:
        """Return the keys that have no effect in this traffic, without regard to periods."""
        source = next(key for key in TRAFFIC_SOURCES if getattr(self, key) is not None)
        if self.routes and source == "network":
            source = "routes"
        keys = self.model_fields_set & keys_without_effect(source)
        if self.pedestrian_tracks is not None:
            keys -= _TRACK_KEYS
        if not keys and self.counts:
            source = "counts"
            keys = self.model_fields_set & _RANDOM_TRIP_KEYS
        if not keys and self.vehicles is not None:
            source = "vehicles"
            keys = self.model_fields_set & {"vehicles_per_lane_km", "vehicles_per_h"}
        if not keys and self.vehicles_per_h is not None:
            source = "vehicles_per_h"
            keys = self.model_fields_set & _HELD_NUMBER_KEYS
        return UnusedKeys("traffic", source, keys)
