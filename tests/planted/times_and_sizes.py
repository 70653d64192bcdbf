"""Times, periods, weights, zones, gamma, levels of roads, sizes and speeds."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from tests.conftest import collection, feature
from tests.planted import scenes
from tests.planted.case import Case, Plant, add, both, fcd, file, key, make, text, track
from tests.planted.reference_systems import CRS84, degrees, xml_traffic
from tests.planted.scenes import Scene, street, tracks
from tests.planted.truth import (
    STREET,
    drive,
    traffic,
)

DAY = STREET.frames
NIGHT = traffic(drive("c", "car", -20.13, -1.63, 2.03), drive("d", "truck", 60.0, 1.57, -3.1))
PERIODS = replace(STREET, periods=((3.0, DAY), (1.0, NIGHT)))


def periods() -> Scene:
    """A day and a night, three to one."""
    scene = street(PERIODS)
    del scene.config["traffic.fcd"], scene.files["fcd.csv"]
    scene.files |= {"day.csv": scenes.fcd_csv(DAY), "night.csv": scenes.fcd_csv(NIGHT)}
    scene.config["traffic.periods"] = [
        {"name": "day", "weight": 3, "fcd": "day.csv"},
        {"name": "night", "weight": 1, "fcd": "night.csv"},
    ]
    return scene


def period(number: int, **values: Any) -> Plant:
    """Change keys of a period."""

    def plant(scene: Scene) -> None:
        rows = [dict(row) for row in scene.config["traffic.periods"]]
        rows[number] |= values
        scene.config["traffic.periods"] = rows

    return plant


def zones(ring: list[list[float]], name: str = "stop line", crs: str | None = None) -> str:
    """A file with one zone."""
    return collection(feature({"type": "Polygon", "coordinates": [[*ring, ring[0]]]}, name=name), crs=crs)


RING = [[5.0, -4.0], [15.0, -4.0], [15.0, 0.0], [5.0, 0.0]]
ZONES = make(key("score.zones", "zones.geojson"), add("zones.geojson", zones(RING)))
BRIDGE_M = 7.0
DECK_ONLY = STREET.lifted(BRIDGE_M)
ON_DECK = replace(
    STREET, periods=DECK_ONLY.periods, mounts=DECK_ONLY.mounts, region_m=(20.0, 0.0, 7.5), size_m=(40.0, 20.0, 5.0)
)
BRIDGE = file("net.net.xml", lambda _: scenes.network(lanes={"_up": BRIDGE_M}))


def without_frames(*numbers: int) -> Callable[[Scene], str]:
    """The finished file without some time steps."""

    def content(scene: Scene) -> str:
        left_out = {number * 0.5 for number in numbers}
        return scenes.csv_text([row for row in scenes.fcd_rows(scene.truth.frames) if row["time"] not in left_out], ";")

    return content


def kind(name: str, **sizes: float) -> Plant:
    """Change the size of a kind."""

    def plant(scene: Scene) -> None:
        scene.config["traffic.kinds"] = [
            {**row, **sizes} if row["name"] == name else row for row in scene.config["traffic.kinds"]
        ]

    return plant


TIMES_AND_SIZES = (
    Case(
        "milliseconds of FCD with a period of 500 s",
        make(key("traffic.frame_period_s", 0.5)),
        both(fcd(time=lambda row: row["time"] * 1000.0), key("traffic.frame_period_s", 500)),
        "traffic.fcd = 'fcd.csv'",
        "got 0.004 m/s as the highest speed",
        is_error=False,
    ),
    Case(
        "numbers of frames of FCD as seconds",
        street,
        both(fcd(time=lambda row: row["time"] / 0.5), key("traffic.frame_period_s", 1)),
        "traffic.fcd = 'fcd.csv'",
        "got 2 m/s as the highest speed",
        is_error=False,
    ),
    Case(
        "dates of FCD",
        street,
        fcd(time=lambda row: row["time"] + 1.6e9),
        "fcd.csv: row 1",
        "subtract the start of the recording",
    ),
    Case(
        "fifth of the times of FCD",
        make(key("traffic.frame_period_s", 0.5)),
        both(fcd(time=lambda row: row["time"] / 5.0), key("traffic.frame_period_s", 0.1)),
        "traffic.fcd = 'fcd.csv'",
        "got 0.2 times the speed of the motion",
        is_error=False,
    ),
    Case(
        "numbers of frames of tracks as seconds",
        tracks,
        track(t=lambda row: row["t"] / 0.5),
        "traffic.tracks",
        "got 2 m/s as the highest speed",
        is_error=False,
        extension="tracks",
    ),
    Case(
        "milliseconds of tracks as seconds",
        tracks,
        track(t=lambda row: row["t"] * 1000.0),
        "traffic.tracks",
        "Most steps of the file are that long: check the unit of its times",
        is_error=False,
        extension="tracks",
    ),
    Case(
        "dates of tracks in milliseconds",
        tracks,
        track(t=lambda row: (row["t"] + 1.6e9) * 1000.0),
        "tracks.csv: line 2: t",
        "Check the unit of the times: milliseconds are no seconds",
        extension="tracks",
    ),
    Case(
        "times of tracks in tenths",
        tracks,
        track(t=lambda row: row["t"] / 10.0),
        "traffic.tracks",
        "vehicles move at 40 m/s, 2.9 times the speed limit",
        is_error=False,
        extension="tracks",
    ),
    Case(
        "warm-up longer than the recording",
        street,
        key("traffic.warmup_s", 60),
        "traffic.warmup_s = 60",
        "the duration of fcd.csv is 19.5 s",
    ),
    Case(
        "steps of azimuth that do not divide the circle",
        street,
        key("sensors.small", {**scenes.sensor(STREET), "azimuth_step_deg": 0.7}),
        "sensors.small",
        "azimuth_step_deg = 0.7 does not divide 360",
    ),
    Case(
        "range of a sensor in kilometres",
        street,
        key("sensors.small", {**scenes.sensor(STREET), "range_m": 0.1}),
        "site pole_a",
        "Move it within the range of small, 0.1 m",
    ),
    Case(
        "times in milliseconds",
        street,
        fcd(time=lambda row: row["time"] * 1000.0),
        "frame_period_s = 0.5",
        "the time steps of fcd.csv are 500 s apart",
    ),
    Case(
        "times in minutes",
        street,
        fcd(time=lambda row: round(row["time"] / 60.0, 3)),
        "fcd.csv",
        "or times are wrong",
    ),
    Case(
        "times out of order",
        street,
        file("fcd.csv", lambda s: scenes.csv_text(sorted(scenes.fcd_rows(s.truth.frames), key=lambda r: r["id"]), ";")),
        "fcd.csv: row 41",
        "time 0 s comes after 19.5 s",
    ),
    Case(
        "missing steps of XML",
        make(xml_traffic("")),
        file(
            "fcd.xml",
            lambda s: (
                s.files["fcd.xml"]
                .replace('<timestep time="7.00">', "<!--")
                .replace('</timestep>\n<timestep time="9.50">', '--><timestep time="9.50">')
            ),
        ),
        "fcd.xml",
        "steps are missing",
    ),
    Case(
        "vehicles that disappear for a second",
        street,
        file("fcd.csv", without_frames(15, 16, 17)),
        "fcd.csv",
        "'a' between 7 s and 9 s",
        is_error=False,
    ),
    Case(
        "period of frames between the steps",
        street,
        key("traffic.frame_period_s", 0.3),
        "traffic: frame_period_s = 0.3",
        "the time steps of fcd.csv are 0.5 s apart",
    ),
    Case(
        "more frames than recorded",
        make(key("traffic.frames", 40)),
        key("traffic.frames", 48),
        "frames = 48",
        "fcd.csv has 40 frames",
    ),
    Case(
        "blocks that do not divide the frames",
        make(key("traffic.frames", 40)),
        key("tpog.blocks", 7),
        "scenario.toml",
        "tpog.blocks = 7 does not divide traffic.frames = 40",
    ),
    Case(
        "gap in tracks",
        tracks,
        file(
            "tracks.csv",
            lambda s: scenes.csv_text([row for row in scenes.track_rows(s.truth.frames) if not 6.0 <= row["t"] < 11.0]),
        ),
        "tracks",
        "2 gaps in tracks are too long to be interpolated",
        is_error=False,
        extension="tracks",
    ),
    Case(
        "unit of time of tracks",
        tracks,
        key("traffic.track_columns", {**scenes.TRACK_COLUMNS, "time_unit": "ms"}),
        "tracks",
        "seconds in a column of milliseconds give this",
        extension="tracks",
    ),
    Case("weight of a period below zero", periods, period(1, weight=-1), "traffic.periods.1.weight", "got -1"),
    Case(
        "weights too far apart",
        periods,
        both(period(0, weight=1e300), period(1, weight=1e-300)),
        "traffic.periods",
        "weights 1e+300, 1e-300",
    ),
    Case(
        "periods of one name",
        periods,
        period(1, name="day"),
        "scenario.toml: traffic",
        "two periods have the same name: day",
    ),
    Case("file of a period missing", periods, period(1, fcd="evening.csv"), "evening.csv", "no such file"),
    Case(
        "period elsewhere",
        periods,
        file("night.csv", lambda _: scenes.fcd_csv(NIGHT, x=lambda row: row["x"] + 5000.0)),
        "traffic.periods (night)",
        "no vehicle ever enters the region of interest",
        is_error=False,
    ),
    Case(
        "period against the lanes",
        periods,
        file("night.csv", lambda _: scenes.fcd_csv(NIGHT, y=lambda row: -row["y"])),
        "night.csv",
        "on lanes that lead the other way",
    ),
    Case(
        "weight of a kind that is not there",
        make(key("score.weights.kinds", {"truck": 2.0})),
        key("score.weights.kinds", {"lorry": 2.0}),
        "score.weights",
        "lorry",
    ),
    Case(
        "zone of weights where nobody drives",
        make(
            key("score.weights.zones", {"line": {"polygon_m": RING, "weight": 2.0}}), key("score.others", ["seen_well"])
        ),
        key("score.weights.zones", {"line": {"polygon_m": [[y + 30, x] for x, y in RING], "weight": 2.0}}),
        "score.weights.zones.line",
        "no vehicle has its centre in the zone",
        is_error=False,
    ),
    Case(
        "zone outside of the region",
        ZONES,
        file("zones.geojson", lambda _: zones([[x, y + 40.0] for x, y in RING])),
        "zones.geojson: zone stop line",
        "expected an area in the region of interest",
    ),
    Case(
        "zone with x and y swapped",
        ZONES,
        file("zones.geojson", lambda _: zones([[y, x] for x, y in RING])),
        "score.zones",
        "outside the region of interest, so nobody in them counts: 100 % of stop line",
        is_error=False,
    ),
    Case(
        "zone that crosses itself",
        ZONES,
        file("zones.geojson", lambda _: zones([RING[0], RING[2], RING[1], RING[3]])),
        "zones.geojson: feature 0 (stop line)",
        "Self-intersection",
    ),
    Case(
        "zone without a name",
        ZONES,
        text("zones.geojson", '"name": "stop line"', '"name": ""'),
        "zones.geojson",
        "name",
    ),
    Case(
        "zone in degrees without a reference system",
        ZONES,
        file("zones.geojson", lambda _: zones([list(degrees(*p)) for p in RING], crs=CRS84)),
        "zones.geojson",
        "the position of the world frame on the Earth is unknown",
    ),
    Case("gamma below its smallest value", street, key("score.gamma", 1e-300), "score.gamma", "1e-300"),
    Case(
        "gamma below zero",
        make(key("score.gamma", math.inf), truth=replace(STREET, gamma=math.inf)),
        key("score.gamma", -2),
        "score.gamma",
        "-2",
    ),
    Case(
        "gamma of zero",
        make(key("score.gamma", "auto"), truth=replace(STREET, gamma=10.0 * 0.5**1.16)),
        key("score.gamma", 0),
        "score.gamma",
        "gamma is 0",
        is_error=False,
    ),
    Case("size of the region no multiple of voxels", street, key("roi.size_m", [40.2, 20, 5]), "roi", "40.2"),
    Case(
        "vehicles of a bridge without their height",
        make(BRIDGE, truth=ON_DECK),
        fcd(z=lambda row: row["z"] - 3.5),
        "traffic.fcd = 'fcd.csv'",
        "their lanes",
    ),
    Case(
        "network without the bridge",
        make(BRIDGE, truth=ON_DECK),
        file("net.net.xml", lambda _: scenes.network()),
        "traffic.fcd = 'fcd.csv'",
        "7.0 m above their lanes",
    ),
    Case(
        "car of half a metre", street, kind("car", length_m=0.45), "traffic.kinds", "0.45 x 1.8 x 1.5 m", is_error=False
    ),
    Case(
        "length and width of a car swapped",
        street,
        kind("car", length_m=1.8, width_m=4.5),
        "traffic.kinds",
        "1.8 x 4.5 x 1.5 m",
        is_error=False,
    ),
    Case(
        "sizes of a truck in centimetres",
        street,
        kind("truck", length_m=820.0, width_m=240.0, height_m=330.0),
        "traffic.kinds",
        "820 x 240 x 330 m",
        is_error=False,
    ),
    Case(
        "sizes of a truck in feet",
        street,
        kind("truck", length_m=26.9, width_m=7.87, height_m=10.8),
        "traffic.kinds",
        "26.9 x 7.87 x 10.8 m",
        is_error=False,
    ),
    Case("type without a size", street, text("fcd.csv", "truck", "lorry"), "traffic.kinds", "'lorry'"),
    Case(
        "sizes of tracks in centimetres",
        tracks,
        track(l=lambda row: row["l"] * 100, w=lambda row: row["w"] * 100, h=lambda row: row["h"] * 100),
        "tracks.csv: line 2: l",
        "got 450 m",
        extension="tracks",
    ),
    Case(
        "cars of tracks of half a metre",
        tracks,
        track(l=lambda row: row["l"] / 10),
        "traffic.tracks",
        "0.45 x 1.8 x 1.5 m",
        is_error=False,
        extension="tracks",
    ),
    Case(
        "speeds of FCD in km/h",
        street,
        fcd(speed=lambda row: row["speed"] * 3.6),
        "traffic.fcd = 'fcd.csv'",
        "3.6 times the speed of the motion",
        is_error=False,
    ),
)
