"""Feet and radians, order of coordinates, directions, sides of the road, sensors upside down."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from tests.planted import scenes
from tests.planted.case import Case, fcd, file, key, make, mounts, site_names, track
from tests.planted.heights import mesh_scene
from tests.planted.scenes import Scene, street, tracks
from tests.planted.truth import (
    STREET,
    Mount,
    Prism,
)

FOOT_M = 0.3048
ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")

NARROW = replace(
    STREET,
    azimuths_deg=tuple(range(-10, 11, 2)),
    elevations_deg=(-8.0, -4.0, 0.0),
    mounts=(("pole_a", Mount(20.3, 14.2, 3.1, -90.0)),),
)
"""A sensor with a narrow field of view, that looks south across the street."""

MANY_RINGS = replace(STREET, elevations_deg=tuple(range(-20, 12, 2)), azimuths_deg=tuple(range(0, 360, 6)))
RADIANS = replace(MANY_RINGS, elevations_deg=tuple(math.radians(angle) for angle in MANY_RINGS.elevations_deg))

TILTED = replace(NARROW, elevations_deg=(-4.0, 0.0, 4.0), mounts=(("mast", Mount(20.3, 20.2, 14.1, -90.0, -35.0)),))
"""The same on a high mast, that looks down."""

DOWNWARD = replace(STREET, elevations_deg=(-30.0, -22.0, -15.0, -9.0))


def feet_tracks() -> Scene:
    """Tracks in feet, as the mapping says."""
    scene = tracks(length_unit="ft")
    rows = [
        {name: value / FOOT_M if name in ("x", "y", "z", "l", "w", "h") else value for name, value in row.items()}
        for row in scenes.track_rows(STREET.frames)
    ]
    scene.files["tracks.csv"] = scenes.csv_text(rows)
    return scene


TURNED = replace(
    STREET,
    solids=(*STREET.solids, Prism("hall", ((-3.0, 14.0), (3.0, 14.0), (3.0, 24.0), (-3.0, 24.0)), 0.0, 5.0)),
)
"""With a hall whose coordinates, swapped, are on the road."""


def second_road(scene: Scene) -> None:
    """Add a road to the north, where the house would be in feet."""
    lane = '<lane id="north_0" index="0" length="130" speed="13.9" shape="-40,21 90,21"/>'
    scene.replace("net.net.xml", "</net>", f'<edge id="north" from="n" to="m">{lane}</edge>\n</net>')


def y_up(prisms: Sequence[Prism]) -> str:
    """A Wavefront file with y up."""
    turned = []
    for line in scenes.obj_mesh(prisms).splitlines():
        word, *values = line.split(" ")
        turned.append(f"v {values[0]} {values[2]} {-float(values[1]):.6f}" if word == "v" else line)
    return "\n".join(turned) + "\n"


UNITS = (
    Case(
        "FCD in feet",
        street,
        fcd(x=lambda row: row["x"] / FOOT_M, y=lambda row: row["y"] / FOOT_M),
        "traffic.fcd = 'fcd.csv'",
        "beside every lane that leads their way",
        is_error=False,
    ),
    Case(
        "tracks in feet",
        tracks,
        track(x=lambda row: row["x"] / FOOT_M, y=lambda row: row["y"] / FOOT_M),
        "traffic.tracks",
        "beside every lane that leads their way",
        is_error=False,
        extension="tracks",
    ),
    Case(
        "tracks in feet without their unit",
        feet_tracks,
        key("traffic.track_columns", scenes.TRACK_COLUMNS),
        "traffic.tracks",
        "14.76 x 5.91 x 4.92 m",
        is_error=False,
        extension="tracks",
    ),
    Case(
        "sites in feet",
        street,
        mounts(lambda mount: replace(mount, x_m=100 + mount.x_m / FOOT_M, y_m=mount.y_m / FOOT_M)),
        "site pole_b",
        "m from the region of interest",
    ),
    Case(
        "heights of sites in a column of feet",
        street,
        site_names(z_m="height_ft"),
        "sites.csv",
        "z_m",
    ),
    Case(
        "mesh in millimetres",
        partial(mesh_scene, STREET),
        file("solids.obj", lambda _: scenes.obj_mesh(STREET.solids, 1000.0)),
        "solids.obj",
        "15 km from the region of interest",
    ),
    Case(
        "mesh in kilometres",
        partial(mesh_scene, STREET),
        file("solids.obj", lambda _: scenes.obj_mesh(STREET.solids, 0.001)),
        "statics.meshes = 'solids.obj'",
        "expected a mesh in metres, got one of 0.016 x 0.016 x 0.006 m",
        is_error=False,
    ),
    Case(
        "mesh in centimetres",
        partial(mesh_scene, STREET),
        file("solids.obj", lambda _: scenes.obj_mesh(STREET.solids, 100.0)),
        "statics",
        "the nearest solid is 1,446 m from the region of interest",
        is_error=False,
    ),
    Case(
        "mesh with y up",
        partial(mesh_scene, STREET),
        file("solids.obj", lambda _: y_up(STREET.solids)),
        "statics.meshes = 'solids.obj'",
        "stands on the ground beside the roads only with y up",
        is_error=False,
    ),
    Case(
        "footprints in feet",
        make(second_road),
        file("solids.geojson", lambda s: scenes.solids(s.truth.solids, place=lambda x, y: (x / FOOT_M, y / FOOT_M))),
        "statics",
        "read in feet or with x and y swapped",
        is_error=False,
    ),
    Case(
        "x and y of footprints swapped",
        make(truth=TURNED),
        file("solids.geojson", lambda s: scenes.solids(s.truth.solids, place=lambda x, y: (y, x))),
        "statics",
        "read with x and y swapped, they would cover almost none",
        is_error=False,
    ),
    Case(
        "footprints on the road without a network",
        make(key("traffic.roads", None)),
        file("solids.geojson", lambda s: scenes.solids(s.truth.solids, place=lambda x, y: (x, y - 6.5))),
        "statics",
        "of the volume that vehicles occupy is inside solids",
        is_error=False,
    ),
    Case(
        "angles of sites in radians",
        street,
        mounts(lambda mount: replace(mount, **{name: round(math.radians(getattr(mount, name)), 4) for name in ANGLES})),
        "sites",
        "with yaws that look like radians: 0.5236, 2.3963",
        is_error=False,
    ),
    Case(
        "pitch beyond the vertical",
        street,
        mounts(lambda mount: replace(mount, pitch_deg=95.0)),
        "sites.csv: line 2 (pole_a): pitch_deg",
        "expected an angle between -90 and 90, got 95",
    ),
    Case(
        "heights of sites in centimetres",
        street,
        mounts(lambda mount: replace(mount, z_m=mount.z_m * 100.0)),
        "site pole_a",
        "305.0 m from the region of interest",
    ),
    Case(
        "heights of sites in decimetres",
        street,
        mounts(lambda mount: replace(mount, z_m=mount.z_m * 10.0)),
        "sites",
        "all sensors are 32.0 m above the road beside them (median)",
        is_error=False,
    ),
    Case(
        "FCD angles in radians",
        street,
        fcd(angle=lambda row: math.radians(row["angle"])),
        "traffic.fcd = 'fcd.csv'",
        "degrees off their motion",
    ),
    Case(
        "FCD angles counter-clockwise from east",
        street,
        fcd(angle=lambda row: 90.0 - row["angle"]),
        "traffic.fcd = 'fcd.csv'",
        "(median of all 90 degrees)",
    ),
    Case(
        "FCD angles of the rear",
        street,
        fcd(angle=lambda row: row["angle"] + 180.0),
        "traffic.fcd = 'fcd.csv'",
        "(median of all 180 degrees)",
    ),
    Case(
        "yaw of tracks in degrees",
        tracks,
        track(a=lambda row: math.degrees(row["a"])),
        "traffic.tracks",
        "degrees off their motion",
        extension="tracks",
    ),
    Case(
        "yaw of tracks clockwise from north",
        tracks,
        track(a=lambda row: math.pi / 2.0 - row["a"]),
        "traffic.tracks",
        "(median of all 90 degrees)",
        extension="tracks",
    ),
    Case(
        "column of yaws in radians",
        street,
        site_names(yaw_deg="yaw_rad"),
        "sites.csv",
        "yaw_deg",
    ),
    Case(
        "column of headings",
        street,
        site_names(yaw_deg="heading_deg"),
        "sites.csv",
        "counter-clockwise from east",
    ),
    Case(
        "column of pans",
        street,
        site_names(yaw_deg="Pan"),
        "sites.csv",
        "counter-clockwise from east",
    ),
    Case(
        "sensor that points up",
        street,
        mounts(lambda mount: replace(mount, pitch_deg=60.0)),
        "sites",
        "point more than 30 degrees up",
        is_error=False,
    ),
    Case(
        "elevations in radians",
        make(truth=MANY_RINGS),
        key("sensors.small", scenes.sensor(RADIANS)),
        "sensors.small",
        "they look like radians",
        is_error=False,
    ),
    Case(
        "column of downward tilts",
        street,
        site_names(pitch_deg="tilt"),
        "sites.csv",
        "positive for nose up",
    ),
    Case(
        "column of heights",
        street,
        site_names(z_m="height"),
        "sites.csv",
        "the sensor's z in the world frame",
    ),
    Case(
        "bearing as yaw",
        make(truth=NARROW),
        mounts(lambda mount: replace(mount, yaw_deg=90.0 - mount.yaw_deg)),
        "sites",
        "have no beam that meets the region of interest: pole_a",
        is_error=False,
    ),
    Case(
        "sensor upside down",
        make(truth=DOWNWARD),
        mounts(lambda mount: replace(mount, pitch_deg=0.0, roll_deg=180.0)),
        "scenario.toml: sites",
        "no beam crosses a voxel with traffic",
        is_error=False,
    ),
    Case(
        "pitch and roll swapped",
        make(truth=TILTED),
        mounts(lambda mount: replace(mount, pitch_deg=mount.roll_deg, roll_deg=mount.pitch_deg)),
        "sites",
        "have no beam that meets the region of interest: mast",
        is_error=False,
    ),
    Case(
        "pitch positive for nose down",
        make(truth=TILTED),
        mounts(lambda mount: replace(mount, pitch_deg=-mount.pitch_deg)),
        "sites",
        "have no beam that meets the region of interest: mast",
        is_error=False,
    ),
    Case(
        "x and y of FCD swapped",
        street,
        fcd(x=lambda row: row["y"], y=lambda row: row["x"]),
        "traffic.fcd = 'fcd.csv'",
        "(median of all 90 degrees)",
    ),
    Case(
        "x and y of FCD with its angles swapped",
        street,
        fcd(x=lambda row: row["y"], y=lambda row: row["x"], angle=lambda row: 90.0 - row["angle"]),
        "traffic.fcd = 'fcd.csv'",
        "of moving vehicles are more than",
        is_error=False,
    ),
    Case(
        "x and y of tracks swapped",
        tracks,
        track(x=lambda row: row["y"], y=lambda row: row["x"]),
        "traffic.tracks",
        "of moving vehicles are more than",
        extension="tracks",
    ),
    Case(
        "FCD of left-hand traffic on a network of right-hand traffic",
        street,
        fcd(y=lambda row: -row["y"]),
        "traffic.fcd = 'fcd.csv'",
        "on lanes that lead the other way",
    ),
    Case(
        "network of left-hand traffic",
        street,
        file(
            "net.net.xml",
            lambda _: scenes.network().replace(",1.6,", ",?,").replace(",-1.6,", ",1.6,").replace(",?,", ",-1.6,"),
        ),
        "traffic.fcd = 'fcd.csv'",
        "on lanes that lead the other way",
    ),
    Case(
        "tracks mirrored",
        tracks,
        track(y=lambda row: -row["y"], a=lambda row: -row["a"]),
        "traffic.tracks",
        "on lanes that lead the other way",
        extension="tracks",
    ),
    Case(
        "FCD in reverse order of time",
        street,
        file("fcd.csv", lambda scene: scenes.fcd_csv(scene.truth.frames[::-1])),
        "traffic.fcd = 'fcd.csv'",
        "on lanes that lead the other way",
    ),
)
