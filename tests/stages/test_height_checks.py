"""Heights without a common zero are errors; hillsides, decks, bridges and elevated roads are valid."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from egvs.formats import ply
from egvs.stages import height_checks
from egvs.traffic.network import Shape
from tests.stages.conftest import LANES, net_xml
from tests.stages.test_check import SCENARIOS, box, found, sites, statics


def house(foot_m: float, height_m: float = 6.0, north_m: float = 8.0, **more: object) -> dict:
    """A house of 4 m x 3 m beside the street, whose northern kerb is at y = 5.2."""
    properties = {"kind": "building", "base_m": foot_m, "height_m": foot_m + height_m, "name": "house", **more}
    return box((14, north_m), (18, north_m + 3), **properties)


def heights(folder: Path, *settings: str) -> list[str]:
    return found(folder, *settings).get("heights", [])


def lifted(lanes: str, z_m: float, slope: float = 0.0) -> str:
    """Lanes with heights: z_m + slope * x."""

    def with_z(shape: re.Match[str]) -> str:
        points = [tuple(map(float, point.split(","))) for point in shape[1].split()]
        return 'shape="' + " ".join(f"{x:g},{y:g},{z_m + slope * x:g}" for x, y in points) + '"'

    return re.sub(r'shape="([^"]*)"', with_z, lanes)


def lift_scenario(street: Path, z_m: float) -> None:
    """Put roads, region and sites at another height; solids count from the ground."""
    (street / "net.net.xml").write_text(net_xml(lifted(LANES, z_m)))
    text = (street / "scenario.toml").read_text()
    assert "center_m = [20, 0, 2.5]" in text
    (street / "scenario.toml").write_text(text.replace("[20, 0, 2.5]", f"[20, 0, {z_m + 2.5}]"))
    sites(street, f"pole_a,10,12,{z_m + 3}", f"pole_b,30.5,-12,{z_m + 3}")


# --- errors: another zero


@pytest.mark.parametrize("offset_m", [20.0, 112.0, 2000.0])
def test_floating_footprints_are_an_error(street: Path, offset_m: float) -> None:
    statics(street, house(offset_m))
    assert heights(street) == [
        f"statics.footprints = 'statics.geojson': 1 of 1 solid near the region has its foot {offset_m:,.1f} m above the"
        " road beside it: house"
    ]
    statics(street, house(0.0))
    assert heights(street) == []


def test_offset_of_most_solids_of_a_file_is_an_error(street: Path) -> None:
    others = [house(112.0, north_m=north, name=f"h{north}") for north in (14.0, 20.0)]
    statics(street, house(0.0), *others)
    (told,) = heights(street)
    assert (
        "2 of 3 solids near the region have their foot 112.0 m above the road beside them (median): h14.0, h2" in told
    )
    assert not told.startswith("[")
    statics(street, house(112.0), house(0.0, north_m=14.0), house(0.0, north_m=20.0))
    (told,) = heights(street)
    assert told.startswith("[statics.footprints") and "1 of 3 solids near the region has its foot 112.0 m above" in told


def test_one_file_among_others_is_named(street: Path) -> None:
    """Solids of one file do not hide the offset of another."""
    (street / "b.geojson").write_text((street / "statics.geojson").read_text())
    statics(street, house(112.0))
    told = heights(street, 'statics.footprints=["b.geojson", "statics.geojson"]')
    assert [line.partition(": ")[0] for line in told] == ["statics.footprints = 'statics.geojson'"]


def test_floating_polygons_and_meshes_are_errors(street: Path) -> None:
    params = '<param key="height" value="40"/><param key="min_height" value="34"/>'
    shape = f'<poly id="a" type="building" fill="1" shape="14,8 18,8 18,11 14,11">{params}</poly>'
    (street / "a.poly.xml").write_text(f"<additional>{shape}</additional>")
    mesh = trimesh.creation.box((4, 3, 6))
    mesh.apply_translation((16, 9.5, 37))
    mesh.export(street / "m.ply")
    told = heights(
        street, "statics.footprints=[]", 'statics.polygons=["a.poly.xml"]', 'statics.meshes=[{file="m.ply"}]'
    )
    assert [line.partition(": ")[0] for line in told] == ["statics.polygons = 'a.poly.xml'", "statics.meshes = 'm.ply'"]
    assert all("34.0 m above the road" in line for line in told)
    moved = 'statics.meshes=[{file="m.ply", offset_m=[0, 0, -34]}]'
    assert heights(street, "statics.footprints=[]", moved) == []


def test_buried_mesh_is_an_error(street: Path) -> None:
    """The road is above sea level, the mesh at z = 0."""
    lift_scenario(street, 112.0)
    mesh = trimesh.creation.box((4, 3, 6))
    mesh.apply_translation((16, 9.5, 3))
    mesh.export(street / "m.ply")
    (told,) = heights(street, 'statics.meshes=[{file="m.ply"}]')
    assert told == (
        "statics.meshes = 'm.ply': 1 of 1 solid near the region has its roof 106.0 m below the road beside it: m_0"
    )
    assert heights(street, 'statics.meshes=[{file="m.ply", offset_m=[0, 0, 112]}]') == []


def test_heights_above_sea_level_on_a_lifted_ground_are_an_error(street: Path) -> None:
    """The heights of footprints count from the ground already."""
    lift_scenario(street, 112.0)
    statics(street, house(0.0))
    assert heights(street) == []
    statics(street, house(112.0, z_datum="world"))
    assert heights(street) == []
    statics(street, house(112.0))
    (told,) = heights(street)
    assert "1 of 1 solid near the region has its foot 112.0 m above the road beside it: house" in told


def test_hint_names_the_key_of_the_zero(street: Path, run_egvs) -> None:
    statics(street, house(112.0))
    code, out, _ = run_egvs("check", street)
    assert code == 2
    assert "Add -112.0 m to base_m and height_m" in out
    code, _, err = run_egvs("run", street, "--out", street / "run")
    assert code == 2 and "112.0 m above the road" in err
    assert not (street / "run" / "scores.parquet").exists()


def test_thin_solids_beside_the_road_float_above_decks(street: Path) -> None:
    """Garages and walls are as thin as decks, but no deck beside a road is 30 m high."""
    statics(street, house(30.0, 2.5, name="garage"))
    (told,) = heights(street)
    assert "1 of 1 solid near the region has its foot 30.0 m above the road beside it: garage" in told


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize(
    "folder", sorted(path.parent for path in SCENARIOS.glob("*/scenario.toml")), ids=lambda p: p.name
)
def test_shipped_scenarios_have_no_finding(folder: Path) -> None:
    assert heights(folder) == []


# --- recorded traffic


def record(street: Path, z_m: float | str, with_roads: bool = True) -> None:
    """Recorded cars of the street, at a height; an empty text for a file without heights."""
    text = (street / "scenario.toml").read_text()
    roads = 'roads = "net.net.xml"\n' if with_roads else ""
    (street / "scenario.toml").write_text(text.replace('network = "net.net.xml"\n', f'{roads}fcd = "fcd.csv"\n'))
    header, *rows = (street / "fcd.csv").read_text().splitlines()
    if z_m != "":
        header, rows = f"{header};vehicle_z", [f"{row};{z_m}" for row in rows]
    (street / "fcd.csv").write_text("\n".join([header, *rows]) + "\n")


@pytest.mark.parametrize(
    ("z_m", "problem"),
    [
        (0.0, ""),
        (0.9, ""),
        (2.0, "[{}: vehicles drive 2.0 m above their lanes (median; at z = 2.0 m)]"),
        (35.0, "{}: vehicles drive 35.0 m above their lanes (median; at z = 35.0 m)"),
        (-8.0, "{}: vehicles drive 8.0 m below their lanes (median; at z = -8.0 m)"),
    ],
)
def test_recorded_vehicles_are_on_their_lanes(street: Path, z_m: float, problem: str) -> None:
    record(street, z_m)
    expected = [problem.format("scenario.toml: traffic.fcd = 'fcd.csv'")] if problem else []
    assert heights(street) == expected


def test_recorded_vehicles_without_heights_need_a_road_at_zero(street: Path) -> None:
    record(street, "")
    assert heights(street) == []
    lift_scenario(street, 112.0)
    (told,) = heights(street)
    assert (
        told
        == "scenario.toml: traffic.fcd = 'fcd.csv': vehicles drive 112.0 m below their lanes (median; at z = 0.0 m)"
    )


def test_vehicles_on_a_bridge_are_on_its_lanes(street: Path) -> None:
    """Each vehicle is compared with the lane of its level."""
    bridge = lifted(LANES.replace("east", "up").replace("west", "down"), 7.0)
    (street / "net.net.xml").write_text(net_xml(lifted(LANES, 0.0) + bridge))
    record(street, 7.0)
    assert heights(street) == []


def test_vehicles_without_roads_need_the_ground(street: Path) -> None:
    record(street, 112.0, with_roads=False)
    assert heights(street) == [
        "scenario.toml: traffic.fcd = 'fcd.csv': vehicles drive 112.0 m above the ground at z = 0 (median),"
        " since no network is named",
    ]


def test_vehicles_somewhat_above_the_ground_are_a_warning(street: Path) -> None:
    record(street, 2.0, with_roads=False)
    (told,) = heights(street)
    assert "vehicles drive 2.0 m above the ground at z = 0 (median)" in told
    record(street, 0.5, with_roads=False)
    assert heights(street) == []


def test_solids_without_roads_are_compared_with_the_traffic(street: Path) -> None:
    record(street, 0.0, with_roads=False)
    statics(street, house(0.0))
    assert heights(street) == []
    statics(street, house(112.0))
    (told,) = heights(street)
    assert "1 of 1 solid near the region has its foot 112.0 m above the traffic beside it: house" in told


def test_vehicles_on_a_mesh_of_the_road_are_valid(street: Path) -> None:
    record(street, 112.0, with_roads=False)
    text = (street / "scenario.toml").read_text()
    (street / "scenario.toml").write_text(text.replace("[20, 0, 2.5]", "[20, 0, 114.5]"))
    sites(street, "pole_a,10,12,115")
    road = trimesh.Trimesh([[-60, -20, 112], [90, -20, 112], [90, 20, 112], [-60, 20, 112]], [[0, 1, 2], [0, 2, 3]])
    road.export(street / "road.ply")
    statics(street, house(112.0, z_datum="world"))
    assert heights(street, 'statics.meshes=[{file="road.ply"}]') == []


# --- terrain and sites


def write_terrain(street: Path, z_m: float) -> None:
    x_m, y_m = np.meshgrid(np.arange(-60.0, 101.0, 8.0), np.arange(-60.0, 61.0, 8.0))
    points_m = np.column_stack([x_m.ravel(), y_m.ravel(), np.full(x_m.size, z_m)])
    ply.write(street / "ground.ply", points_m)


@pytest.mark.parametrize(
    ("z_m", "told"),
    [
        (0.0, ""),
        (-15.0, "[{}: the road near the region is 15.0 m above the points of the terrain (median)]"),
        (-112.0, "{}: the road near the region is 112.0 m above the points of the terrain (median)"),
        (112.0, "{}: the road near the region is 112.0 m below the points of the terrain (median)"),
    ],
)
def test_terrain_has_the_zero_of_the_road(street: Path, z_m: float, told: str) -> None:
    write_terrain(street, z_m)
    statics(street, house(0.0))
    lines = [line for line in heights(street, "statics.terrain=ground.ply") if "terrain" in line]
    assert lines == ([told.format("statics.terrain = 'ground.ply'")] if told else [])


def test_warns_of_sensors_high_above_the_road(street: Path) -> None:
    sites(street, "pole_a,10,12,43", "pole_b,30.5,-12,43")
    assert heights(street) == ["[sites: all sensors are 43.0 m above the road beside them (median)]"]
    statics(street, box((7, 9), (9.5, 14), kind="building", height_m=42), box((31, -14), (34, -10), height_m=42))
    assert heights(street) == []


# --- valid scenes


@pytest.mark.parametrize(
    "solids",
    [
        [house(-5.0, north_m=20.0)],  # down a hillside
        [house(12.0, north_m=20.0), house(0.0), house(0.0, north_m=14.0)],
        [box((-20, -10), (60, 10), name="deck", kind="bridge", base_m=5, height_m=6)],
        [box((-20, -10), (60, 10), name="deck", kind="footprint", base_m=22, height_m=24)],
        [box((10, -10), (20, 10), name="over", kind="building", base_m=6, height_m=12)],
        [box((10, 6), (20, 10), name="canopy", kind="footprint", base_m=8, height_m=8.4)],
        [house(0.0, 30.0), house(30.0, 88.0, name="tower"), house(118.0, 2.0, name="roof")],
        [house(0.0, 9.0, north_m=8), house(0.0, 7.0, north_m=14)],
    ],
)  # fmt: skip
def test_valid_solids_have_no_finding(street: Path, solids: list[dict]) -> None:
    statics(street, *solids)
    assert heights(street) == []


@pytest.mark.parametrize("foot_m", [12.0, -9.0])
def test_hillside_15_metres_behind_the_kerb_is_no_error(street: Path, foot_m: float) -> None:
    statics(street, house(foot_m, north_m=20.0))
    (told,) = heights(street)
    assert told.startswith("[")


@pytest.mark.parametrize(("offset_m", "side"), [(20.0, "above"), (-35.0, "below")])
def test_common_offset_of_solids_at_several_distances_is_an_error(street: Path, offset_m: float, side: str) -> None:
    """A slope explains the offset of the farthest alone, but not that all have the same one."""
    rows = [house(offset_m, north_m=8.0 + 7.0 * number, name=f"h{number}") for number in range(6)]
    statics(street, *rows)
    (told,) = heights(street)
    assert f"6 of 6 solids near the region have their {'foot' if side == 'above' else 'roof'} " in told
    assert f"m {side} the road beside them (median): h0, h1, h2 and 3 more" in told and not told.startswith("[")
    slope = [house(offset_m * (number + 1) / 6, north_m=8.0 + 7.0 * number, name=f"h{number}") for number in range(6)]
    statics(street, *slope)
    assert [line for line in heights(street) if not line.startswith("[")] == []


def test_houses_below_an_elevated_road_are_valid(street: Path) -> None:
    """The ground is known from the terrain; the road is on a viaduct."""
    lift_scenario(street, 12.0)
    write_terrain(street, 0.0)
    statics(street, house(0.0))
    assert [line for line in heights(street, "statics.terrain=ground.ply") if not line.startswith("[")] == []


def test_houses_along_a_slope_are_valid(street: Path) -> None:
    (street / "net.net.xml").write_text(net_xml(lifted(LANES, 5.0, 0.15)))
    text = (street / "scenario.toml").read_text()
    (street / "scenario.toml").write_text(text.replace("[20, 0, 2.5]", "[20, 0, 8.5]"))
    sites(street, "pole_a,10,12,11", "pole_b,30.5,-12,14")
    statics(street, house(0.0), box((-30, 9), (-20, 14), height_m=5), box((60, 9), (70, 14), height_m=5))
    assert heights(street) == []


def test_points_of_lanes_are_a_few_metres_apart_and_never_too_many() -> None:
    """20 lanes of 900 km would be 3.6 million points."""
    near: Any = SimpleNamespace(lanes=[Shape("0,0,1 12,0,4", "lane a"), Shape("3,3 3,7", "lane b")])
    points_m = height_checks.lane_points_m(near)
    assert points_m.tolist() == [[0, 0, 1], [4, 0, 2], [8, 0, 3], [12, 0, 4], [3, 3, 0], [3, 7, 0]]
    many: Any = SimpleNamespace(lanes=[Shape("0,0 900000,0", f"lane {number}") for number in range(20)])
    assert 1_900_000 < len(height_checks.lane_points_m(many)) <= 2_000_100
