"""Heights without a common zero."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from tests.planted import scenes
from tests.planted.case import Case, Plant, add, fcd, file, key, make, mounts, text
from tests.planted.scenes import Scene, street
from tests.planted.truth import (
    STREET,
    Truth,
    drive,
    traffic,
)

HILL_M = 112.0
RAISED = STREET.lifted(HILL_M)


def mesh_scene(truth: Truth) -> Scene:
    """Solids as a mesh with z of its own, moved by ``offset_m``."""
    scene = street(truth)
    del scene.config["statics.footprints"], scene.files["solids.geojson"]
    scene.config["statics.meshes"] = [{"file": "solids.obj", "offset_m": [0.0, 0.0, truth.ground_m]}]
    scene.files["solids.obj"] = scenes.obj_mesh(STREET.solids)
    return scene


def poly_scene(of_file: str = "", of_network: str = "") -> Scene:
    """Solids as a .poly.xml file."""
    scene = street()
    del scene.config["statics.footprints"], scene.files["solids.geojson"]
    scene.config["statics.polygons"] = ["solids.poly.xml"]
    scene.files["solids.poly.xml"] = scenes.polygons(STREET.solids, location=of_file)
    if of_network:
        scene.files["net.net.xml"] = scenes.network(location=of_network)
    return scene


def terrain_ply(z_m: float) -> str:
    """Points of the ground every 8 m."""
    points = [(x, y, z_m) for x in range(-64, 113, 8) for y in range(-64, 65, 8)]
    header = "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n"
    return header.format(len(points)) + "end_header\n" + "".join("{} {} {}\n".format(*point) for point in points)


def above_ground(height_m: float) -> Plant:
    """Heights of sites from the ground, beside the z of the ground."""

    def step(scene: Scene) -> None:
        rows = []
        for row in scenes.site_rows(scene.truth.mounts):
            row["ground_m"] = row.pop("z_m") - height_m
            rows.append(row)
        scene.files["sites.csv"] = scenes.csv_text(rows)
        scene.config["sites.heights_m"] = [height_m]

    return step


HEIGHTS = (
    Case(
        "property of heights of another program",
        street,
        text("solids.geojson", '"height_m"', '"height"'),
        "solids.geojson: feature 0 (house)",
        "Did you mean height_m?",
    ),
    Case(
        "heights of footprints in feet",
        street,
        text("solids.geojson", '"height_m"', '"height_ft"'),
        "solids.geojson: feature 0 (house)",
        "unknown property 'height_ft'",
    ),
    Case(
        "underside above the roof",
        street,
        text("solids.geojson", '"base_m": 0.0', '"base_m": 7.0'),
        "solids.geojson: feature 0 (house)",
        "expected height_m above base_m = 7, got 6",
    ),
    Case(
        "footprints above sea level beside a road at zero",
        street,
        file("solids.geojson", lambda scene: scenes.solids(scene.truth.solids, -HILL_M)),
        "solids.geojson",
        "foot 112.0 m above the road",
    ),
    Case(
        "footprints in world z read as heights above ground",
        make(file("solids.geojson", lambda s: scenes.solids(s.truth.solids, z_datum="world")), truth=RAISED),
        text("solids.geojson", '"z_datum": "world"', '"z_datum": "ground"'),
        "solids.geojson",
        "foot 112.0 m above the road",
    ),
    Case(
        "footprints above ground read as world z",
        make(truth=RAISED),
        file("solids.geojson", lambda s: scenes.solids(STREET.solids, z_datum="world")),
        "solids.geojson",
        "below the road",
    ),
    Case(
        "mesh without the height of its zero",
        partial(mesh_scene, RAISED),
        key("statics.meshes", [{"file": "solids.obj"}]),
        "statics.meshes = 'solids.obj'",
        "below the road",
    ),
    Case(
        "polygons above sea level",
        poly_scene,
        file("solids.poly.xml", lambda s: scenes.polygons(s.truth.solids, -34.0)),
        "statics.polygons = 'solids.poly.xml'",
        "34.0 m above the road",
    ),
    Case(
        "FCD above sea level",
        street,
        fcd(z=lambda row: row["z"] + HILL_M),
        "traffic.fcd = 'fcd.csv'",
        "112.0 m above their lanes",
    ),
    Case(
        "FCD at zero under a raised road",
        make(truth=RAISED),
        fcd(z=lambda row: row["z"] - HILL_M),
        "traffic.fcd = 'fcd.csv'",
        "112.0 m below their lanes",
    ),
    Case(
        "ellipsoidal heights in FCD",
        make(truth=RAISED),
        fcd(z=lambda row: row["z"] + 47.3),
        "traffic.fcd = 'fcd.csv'",
        "47.3 m above their lanes",
    ),
    Case(
        "centres of vehicles as the z of FCD",
        make(truth=replace(STREET, periods=((1.0, traffic(drive("b", "truck", 58.77, 1.57, -1.97))),))),
        fcd(z=lambda row: row["z"] + 1.65),
        "traffic.fcd = 'fcd.csv'",
        "above their lanes",
        is_error=False,
    ),
    Case(
        "FCD above sea level without a network",
        make(key("traffic.roads", None)),
        fcd(z=lambda row: row["z"] + HILL_M),
        "traffic.fcd = 'fcd.csv'",
        "112.0 m above the ground",
    ),
    Case(
        "solids above sea level without a network",
        make(key("traffic.roads", None)),
        file("solids.geojson", lambda scene: scenes.solids(scene.truth.solids, -HILL_M)),
        "solids.geojson",
        "foot 112.0 m above the traffic",
    ),
    Case(
        "terrain above sea level",
        make(key("statics.terrain", "ground.ply"), add("ground.ply", terrain_ply(0.0))),
        file("ground.ply", lambda _: terrain_ply(HILL_M)),
        "statics.terrain = 'ground.ply'",
        "112.0 m below the points of the terrain",
    ),
    Case(
        "terrain in feet",
        make(key("statics.terrain", "ground.ply"), add("ground.ply", terrain_ply(HILL_M)), truth=RAISED),
        file("ground.ply", lambda _: terrain_ply(HILL_M / 0.3048)),
        "statics.terrain = 'ground.ply'",
        "below the points of the terrain",
    ),
    Case(
        "sites above ground on a raised road",
        make(truth=RAISED),
        mounts(lambda mount: replace(mount, z_m=mount.z_m - HILL_M)),
        "site pole_a",
        "z_m = 3.1 is not above the ground (z = 112",
    ),
    Case(
        "heights of sites in another unit",
        street,
        mounts(lambda mount: replace(mount, z_m=0.3)),
        "sites",
        "less than 1 m above the ground",
        is_error=False,
    ),
    Case(
        "centre of the region on the road",
        street,
        key("roi.center_m", (20.0, 0.0, 0.0)),
        "scenario.toml: roi",
        "50.0 % of the region's height is below all roads",
        is_error=False,
    ),
    Case(
        "heights of solids in millimetres",
        street,
        text("solids.geojson", '"height_m": 6.0', '"height_m": 6000.0'),
        "statics.footprints",
        "higher than any building",
        is_error=False,
    ),
    Case(
        "sites above sea level",
        street,
        mounts(lambda mount: replace(mount, z_m=mount.z_m + 61.0)),
        "sites",
        "above the road",
        is_error=False,
    ),
    Case(
        "sites so high that no beam arrives",
        street,
        mounts(lambda mount: replace(mount, z_m=mount.z_m + HILL_M)),
        "site pole_a",
        "m from the region of interest",
    ),
    Case(
        "column ground_m of another zero",
        make(
            above_ground(3.1),
            truth=replace(
                RAISED, mounts=tuple((name, replace(mount, z_m=HILL_M + 3.1)) for name, mount in RAISED.mounts)
            ),
        ),
        text("sites.csv", ",112", ",0"),
        "site pole_a",
        "is not above the ground",
    ),
    Case(
        "region at zero under a raised road",
        make(truth=RAISED),
        key("roi.center_m", STREET.region_m),
        "roi",
        "but the road is at z = 112.0 m",
    ),
)
