"""What is listed twice, and texts: Unicode, encodings, decimal commas."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import replace

from tests.conftest import collection, feature
from tests.planted import scenes
from tests.planted.case import Case, add, both, fcd, file, key, make, site_names, text, track
from tests.planted.reference_systems import xml_traffic
from tests.planted.scenes import Scene, street, tracks
from tests.planted.truth import (
    STREET,
    Truth,
)

RING_TWICE = {**scenes.sensor(STREET), "elevations_deg": (*STREET.elevations_deg, STREET.elevations_deg[0])}


def beam_table(truth: Truth, extra: str = "") -> str:
    """All beams of the sensor as a file."""
    rows = [f"{e},{a}\n" for a in truth.azimuths_deg for e in truth.elevations_deg]
    return "elevation_deg,azimuth_deg\n" + "".join(rows) + extra


NAMED = replace(STREET, mounts=(("Pfahl ä", STREET.mounts[0][1]), ("Pfahl b", STREET.mounts[1][1])))


def two_zones(one: str, other: str) -> str:
    """A file with two zones."""
    rings = {one: [[5, -4], [15, -4], [15, 0], [5, 0]], other: [[20, -4], [30, -4], [30, 0], [20, 0]]}
    return collection(
        *(feature({"type": "Polygon", "coordinates": [[*ring, ring[0]]]}, name=name) for name, ring in rings.items())
    )


REPORTED = make(key("score.zones", "zones.geojson"), add("zones.geojson", two_zones("stop line", "crossing")))
WEIGHTED_ZONE = {"polygon_m": [[5.0, -4.0], [15.0, -4.0], [15.0, 0.0], [5.0, 0.0]], "weight": 2.0}
WEIGHTED = make(key("score.weights.zones", {"line": WEIGHTED_ZONE}), key("score.others", ["seen_well"]))


def another_kind(scene: Scene) -> None:
    """A kind named as another one, in upper case."""
    kinds = scene.config["traffic.kinds"]
    scene.config["traffic.kinds"] = [*kinds, {**kinds[0], "name": "CAR"}]


def under_two_names(scene: Scene) -> str:
    """Each vehicle twice, under another name."""
    rows = scenes.fcd_rows(scene.truth.frames)
    return scenes.csv_text([copy for row in rows for copy in (row, {**row, "id": f"{row['id']}2"})], ";")


DUPLICATES = (
    Case(
        "each vehicle of FCD under two names",
        street,
        file("fcd.csv", under_two_names),
        "scenario.toml: traffic",
        "two vehicles in the same place, such as 'a' and 'a2'",
        is_error=False,
    ),
    Case(
        "sites that differ in case",
        street,
        text("sites.csv", "pole_b", "Pole_A"),
        "sites.csv",
        "sites differ only in upper and lower case: pole_a and Pole_A",
        is_error=False,
    ),
    Case(
        "sensors that differ in case",
        street,
        key("sensors.Small", {**scenes.sensor(STREET), "range_m": 90.0}),
        "scenario.toml: sensors",
        "sensors differ only in upper and lower case: small and Small",
        is_error=False,
    ),
    Case(
        "kinds that differ in case",
        street,
        another_kind,
        "scenario.toml: traffic.kinds",
        "kinds differ only in upper and lower case: car and CAR",
        is_error=False,
    ),
    Case(
        "reported zones that differ in case",
        REPORTED,
        file("zones.geojson", lambda _: two_zones("Stop Line", "stop line")),
        "scenario.toml: score.zones",
        "zones differ only in upper and lower case: Stop Line and stop line",
        is_error=False,
    ),
    Case(
        "reported zones of two Unicode forms",
        REPORTED,
        file("zones.geojson", lambda _: two_zones("\u00c4cker", unicodedata.normalize("NFD", "\u00c4cker"))),
        "scenario.toml: score.zones",
        "zones differ only in the Unicode of accents",
    ),
    Case(
        "weighted zones that differ in case",
        WEIGHTED,
        key("score.weights.zones", {"line": WEIGHTED_ZONE, "Line": WEIGHTED_ZONE}),
        "scenario.toml: score.weights.zones",
        "zones differ only in upper and lower case: line and Line",
        is_error=False,
    ),
    Case(
        "file of tracks listed twice",
        tracks,
        key("traffic.tracks", ["tracks.csv", "tracks.csv"]),
        "scenario.toml: traffic",
        "vehicles overlap in 100 % of the frames",
        is_error=False,
        extension="tracks",
    ),
    Case(
        "name with a blank at its end",
        street,
        text("sites.csv", "pole_b", "pole_a "),
        "sites.csv: line 3 (pole_a)",
        "there are two sites 'pole_a'",
    ),
    Case(
        "decimal comma in a height",
        street,
        text("solids.geojson", '"height_m": 6.0', '"height_m": "6,0"'),
        "solids.geojson: feature 0 (house): height_m",
        "got '6,0' Write numbers with a decimal point, not with a decimal comma",
    ),
    Case(
        "nan as a coordinate",
        street,
        text("sites.csv", "12.2", "nan"),
        "sites.csv: line 2 (pole_a): y_m",
        "got 'nan'",
    ),
    Case(
        "ring listed twice",
        street,
        key("sensors.small", RING_TWICE),
        "sensors.small.elevations_deg",
        "have the same direction as an earlier one",
        is_error=False,
    ),
    Case(
        "beam listed twice",
        make(key("sensors.small", {"beams": "beams.csv", "range_m": 100.0}), add("beams.csv", beam_table(STREET))),
        file("beams.csv", lambda s: beam_table(s.truth, "-20,360\n")),
        "beams.csv",
        "1 of 841 beams have the same direction",
        is_error=False,
    ),
    Case("site listed twice", street, text("sites.csv", "pole_b", "pole_a"), "sites.csv", "two sites 'pole_a'"),
    Case(
        "site of two Unicode forms",
        make(truth=NAMED),
        text("sites.csv", "Pfahl b", unicodedata.normalize("NFD", "Pfahl ä")),
        "sites.csv",
        "differ only in the Unicode of accents",
    ),
    Case(
        "site with an invisible character in its name",
        street,
        text("sites.csv", "pole_b", "pole\u200b_a"),
        "sites.csv",
        "in invisible characters",
    ),
    Case(
        "same sensor under two names",
        street,
        file("sites.csv", lambda s: scenes.sites([(name, s.truth.mounts[0][1]) for name in ("pole_a", "pole_b")])),
        "sites",
        "pole_b = pole_a",
        is_error=False,
    ),
    Case(
        "column of sites twice",
        street,
        site_names(pitch_deg="yaw_deg"),
        "sites.csv",
        "columns are called 'yaw_deg'",
    ),
    Case(
        "two columns for x in FCD",
        street,
        text("fcd.csv", "time;id;x;y;z;angle;type;speed", "time;id;x;y;vehicle_x;angle;type;speed"),
        "fcd.csv",
        "both stand for 'x'",
    ),
    Case(
        "vehicles that share a name",
        street,
        fcd(id=lambda _: "a"),
        "traffic.fcd = 'fcd.csv'",
        "two vehicles share a name",
    ),
    Case(
        "tracks that share a name",
        tracks,
        track(n=lambda _: "a"),
        "traffic.tracks",
        "two vehicles share a name",
        extension="tracks",
    ),
    Case(
        "each row of FCD twice",
        street,
        file("fcd.csv", lambda s: scenes.csv_text([r for row in scenes.fcd_rows(s.truth.frames) for r in (row, row)])),
        "fcd.csv",
        "vehicle 'a' occurs twice in frame 0",
    ),
    Case(
        "footprint listed twice",
        street,
        file("solids.geojson", lambda s: scenes.solids([*s.truth.solids, s.truth.solids[0]])),
        "statics",
        "1 solid has the shape and the position of another one: house",
        is_error=False,
    ),
    Case(
        "kind listed twice",
        street,
        lambda scene: scene.config.update({"traffic.kinds": scene.config["traffic.kinds"] * 2}),
        "scenario.toml: traffic",
        "two kinds have the same name: car",
    ),
    Case(
        "member of GeoJSON twice",
        street,
        text("solids.geojson", '"crs": null', '"crs": null, "features": []'),
        "solids.geojson",
        "features",
    ),
    Case(
        "digits of another script",
        street,
        text("sites.csv", "12.2", "\u0661\u0662.2"),
        "sites.csv: line 2 (pole_a)",
        "expected a finite number",
    ),
    Case(
        "minus sign of typography",
        street,
        text("sites.csv", "-12.17", "\u221212.17"),
        "sites.csv: line 3 (pole_b)",
        "expected a finite number",
    ),
    Case(
        "sites in UTF-16 without a byte order mark",
        make(truth=NAMED),
        file("sites.csv", lambda s: s.files["sites.csv"].encode("utf-16-le")),
        "sites.csv",
        "is no text",
    ),
    Case(
        "commas of sites that can separate thousands",
        street,
        text("sites.csv", "-12.17", '"-12,170"'),
        "sites.csv: line 3: y_m",
        "-12,170 can mean -12170 or -12.170",
    ),
    Case(
        "decimal commas of FCD",
        street,
        file("fcd.csv", lambda s: s.files["fcd.csv"].replace(".", ",")),
        "fcd.csv",
        "invalid value '0,5') Write numbers with a decimal point, not with a decimal comma",
    ),
    Case(
        "decimal commas of FCD in XML",
        make(xml_traffic("")),
        file("fcd.xml", lambda s: re.sub(r"(\d)\.(\d)", r"\1,\2", str(s.files["fcd.xml"]))),
        "fcd.xml",
        "not with a decimal comma",
    ),
    Case(
        "underscore in a number of a site",
        street,
        text("sites.csv", "12.2", "1_2"),
        "line 2 (pole_a): y_m",
        "expected a finite",
    ),
    Case("decimal comma in the scenario", street, key("roi.voxel_m", "0,5"), "roi.voxel_m", "decimal comma"),
    Case(
        "decimal commas of tracks",
        tracks,
        both(
            key("traffic.track_columns", {**scenes.TRACK_COLUMNS, "delimiter": ";"}),
            file("tracks.csv", lambda s: s.files["tracks.csv"].replace(",", ";").replace(".", ",")),
        ),
        "tracks.csv",
        "expected a number, got '4,5' Write numbers with a decimal point, not with a decimal comma",
        extension="tracks",
    ),
    Case(
        "site of another alphabet",
        make(key("score.keep_visibility", ["pole_a"])),
        key("score.keep_visibility", ["pole_\u0430"]),
        "score.keep_visibility",
        "there is no site 'pole_\u0430'",
    ),
)
