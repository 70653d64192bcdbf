"""New scenarios from other maps than OpenStreetMap, and from several maps."""

import csv
import math
import re
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pyproj import CRS
from shapely.geometry import box

from egvs.core.errors import InputError
from egvs.importers import alignment, static_objects, sumo_network
from egvs.importers.map_parts import MapContext, MappedMesh, SolidMap
from egvs.importers.map_readers import MapFile
from egvs.importers.new_scenario import assumed_sizes, scenario_notes
from egvs.importers.osm_solids import ImportCounts, MappedSolid
from egvs.importers.road_source import NetworkRoads
from egvs.importers.static_objects import REPLACED
from egvs.scenario import loading
from egvs.sensors import sites
from tests.importers.creation import create_scenario

SCENARIOS = Path(__file__).parents[2] / "scenarios"
ROUNDABOUT = SCENARIOS / "roundabout" / "network.net.xml"
HILL = SCENARIOS / "hill" / "network.net.xml"

_CORNERS = np.array([[x, y, z] for z in (0.0, 1.0) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], dtype=np.float64)
_BOX_FACES = np.array([
    [0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4],
    [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7],
])  # fmt: skip


def block(name: str, low_m: Sequence[float], size_m: Sequence[float]) -> MappedMesh:
    """A box as a closed mesh."""
    return MappedMesh(name, "building", _CORNERS * size_m + low_m, _BOX_FACES, True)


def reader(name: str, solid_map: SolidMap) -> MapFile:
    """A map file whose reader returns a given map."""
    return MapFile(Path(f"{name}.map"), SimpleNamespace(NAME=name, read_solids=lambda paths, context: solid_map))


def collect(*maps: MapFile) -> static_objects.StaticObjects:
    """Collect objects around the roundabout, whose lanes lie within 50 m of 0, 0."""
    roads = NetworkRoads.read(sumo_network.read_roads(ROUNDABOUT, sumo_network.RoadOptions()), ROUNDABOUT)
    context = MapContext(None, box(-300, -300, 300, 300), streets=roads.streets)
    read = static_objects.read_maps(maps, roads, MapFile(ROUNDABOUT, sumo_network), context)
    return static_objects.collect_objects(read, roads.streets, (0.0, 0.0))


def test_sumo_network_is_used_as_it_is(tmp_path: Path) -> None:
    made = create_scenario(tmp_path / "made", ROUNDABOUT)
    text = ROUNDABOUT.read_text(encoding="utf-8")
    assert (tmp_path / "made" / "network.net.xml").read_text(encoding="utf-8") == re.sub(
        r"<!-- generated on .*?-->\s*", "", text, count=1, flags=re.DOTALL
    )
    scenario = loading.load(tmp_path / "made")
    assert scenario.statics.meshes == ()
    assert made.junction.ring is not None
    assert len(made.flows) == 12


def test_region_and_sites_follow_the_hill(tmp_path: Path) -> None:
    """The junction is 8 m high and level; the main road climbs at 4 % from 20 m beside its middle, on both sides."""
    create_scenario(tmp_path / "made", HILL)
    scenario = loading.load(tmp_path / "made")
    low_m = scenario.roi.center_m[2] - scenario.roi.size_m[2] / 2
    assert low_m == 7.0  # 8 m - 4 % of 20 m = 7.2 m, in steps of 0.25 m
    with (tmp_path / "made" / "sites.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {7.0 < float(row["ground_m"]) < 9.0 for row in rows} == {True}
    heights_m = {
        round(site.pose.z_m - float(row["ground_m"]), 6)
        for row in rows
        for site in sites.candidate_sites(scenario)
        if site.pole == row["site"]
    }
    assert heights_m == {3.0, 4.5, 6.0}


@pytest.mark.parametrize("option", ["lefthand", "walk"])
def test_network_has_its_own_side_and_sidewalks(tmp_path: Path, option: str) -> None:
    with pytest.raises(InputError, match=f"--{option}"):
        create_scenario(tmp_path / "made", ROUNDABOUT, **{option: True})
    assert not (tmp_path / "made").exists()


def test_network_is_not_cut(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--surroundings"):
        create_scenario(tmp_path / "made", ROUNDABOUT, surroundings_m=200.0)


def test_heights_above_sea_level_are_lowered_to_the_ground() -> None:
    meshes = (block("a", (60, 60, 40.0), (10, 10, 6)), block("b", (80, 60, 40.5), (10, 10, 20)))
    (summary,) = (objects := collect(reader("city", SolidMap(meshes=meshes, has_absolute_heights=True)))).maps
    assert [mesh.vertices_m[:, 2].min() for mesh in objects.meshes] == pytest.approx([-0.25, 0.25])
    assert summary.height_range_m == pytest.approx((5.75, 20.25))
    assert "40.25 m, from the lowest points of the objects nearest to the junction, is subtracted" in summary.notes[0]


def test_buildings_without_a_height_get_that_of_their_neighbours() -> None:
    known = [block(f"m{n}", (100.0 + 20 * n, 100, 0), (10, 10, 12.0 + n)) for n in range(3)]
    unknown = MappedSolid("x", "building", box(100, 130, 110, 140), 9.0, "default")
    counts = ImportCounts()
    counts.keep(unknown)
    footprints = reader("footprints", SolidMap((unknown,), counts=counts))
    objects = collect(reader("city", SolidMap(meshes=tuple(known))), footprints)
    assert [(solid.height_m, solid.height_source) for solid in objects.solids] == [(13.0, "neighbours")]
    assert objects.counts.heights["building"] == {"neighbours": 1}
    assert "1 of 1 buildings have neither height nor levels: the median" in scenario_notes(True, objects.counts)[0]
    assert assumed_sizes(objects.counts) == ["heights of 1 of 1 buildings"]


def test_mesh_in_lanes_is_reported() -> None:
    beside, above, inside = (
        block("beside", (100, 100, 0), (9, 9, 9)),
        block("above", (-2, -60, 6), (4, 4, 1)),
        block("inside", (-2, -60, 1), (4, 4, 1)),
    )
    assert collect(reader("one", SolidMap(meshes=(beside, above)))).maps[0].notes == ()
    (note,) = collect(reader("two", SolidMap(meshes=(beside, above, inside)))).maps[0].notes
    assert note == "1 of 3 objects stands in lanes; check the position of the map: inside"


def test_footprint_is_cut_at_the_carriageway() -> None:
    solid = MappedSolid("x", "building", box(-40, -60, 40, -50), 8.0, "height")
    objects = collect(reader("footprints", SolidMap((solid,), counts=ImportCounts())))
    assert objects.counts.cut["building"] == 1
    assert sum(part.area.area for part in objects.solids) < solid.area.area


def test_building_of_another_map_replaces_that_of_openstreetmap(tmp_path: Path) -> None:
    small = Path(__file__).parent / "data" / "small.osm"
    plain = create_scenario(tmp_path / "plain", small)
    n_buildings = plain.statics.objects["building"]
    assert n_buildings > 0
    counts = ImportCounts()
    building = MappedSolid("way/1", "building", box(100, 100, 110, 110), 9.0, "default")
    counts.keep(building)
    other = static_objects.StaticObjects(meshes=(block("a", (98, 98, 0), (20, 20, 5)),))
    rest = static_objects._without_replaced(SolidMap((building,), counts=counts), other)
    assert rest.solids == ()
    assert rest.counts.dropped == {REPLACED: {"building": 1}}


def test_ply_files_are_read_back(tmp_path: Path) -> None:
    import trimesh

    meshes = [block("a", (0, 0, 0), (1, 2, 3)), block("b", (5, 0, 0), (1, 1, 1))]
    (write,) = static_objects.mesh_files(meshes).values()
    write(tmp_path / "building.ply")
    mesh = trimesh.load_mesh(tmp_path / "building.ply", process=False)
    assert mesh.volume == pytest.approx(1 * 2 * 3 + 1)
    assert len(mesh.faces) == 24


def test_alignment_turns_and_moves() -> None:
    """The file's x axis points north in the world, 100 m east of its origin."""
    aligned = alignment.make_alignment([((0, 0), (100, 0)), ((10, 0), (100, 10))], None)
    assert aligned.to_world(np.array([[0.0, 0.0], [2.0, 1.0]])) == pytest.approx(np.array([[100, 0], [99, 2]]))
    assert math.isclose(aligned.scale, 1.0)


@pytest.mark.parametrize(
    ("pairs", "problem"),
    [
        ([((0, 0), (1, 1))], "expected two points"),
        ([((0, 0), (0, 0)), ((10, 0), (11, 0))], "10.00 m apart in the file and 11.00 m on the ground"),
        ([((0, 0), (0, 0)), ((0, 0), (0, 0))], "0.00 m apart"),
    ],
)
def test_rejects_alignment(pairs: list[alignment.PointPair], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        alignment.make_alignment(pairs, None)


def write_terrain(path: Path, rise_east: float) -> Path:
    """An ASCII grid with a plane that rises to the east, around 52 N, 10 E in UTM zone 32."""
    rows, cell_m = 120, 10.0
    east_m, north_m = 568649.0, 5761510.0
    x_m = (np.arange(rows) + 0.5 - rows / 2) * cell_m
    z_m = np.broadcast_to(100 + rise_east * x_m, (rows, rows))
    header = f"ncols {rows}\nnrows {rows}\nxllcorner {east_m - 600}\nyllcorner {north_m - 600}\ncellsize {cell_m}\n"
    path.write_text(header + "\n".join(" ".join(f"{z:.4f}" for z in row) for row in z_m) + "\n", encoding="utf-8")
    path.with_suffix(".prj").write_text(CRS.from_epsg(32632).to_wkt("WKT1_ESRI"), encoding="utf-8")
    return path


def test_roads_buildings_and_sites_follow_a_terrain(tmp_path: Path) -> None:
    """On a plane that rises by 4 % to the east, heights differ by 4 % of the differences of x."""
    small = Path(__file__).parent / "data" / "small.osm"
    made = create_scenario(tmp_path / "made", [small, write_terrain(tmp_path / "plane.asc", 0.04)], (52.0, 10.0))
    x0_m = made.junction.at_m[0]
    for edge in made.streets.network.edges:
        shape_m = edge.lanes[0].shape_m
        assert shape_m[:, 2] == pytest.approx(0.04 * (shape_m[:, 0] - x0_m), abs=0.05)
    scenario = loading.load(tmp_path / "made")
    assert scenario.statics.terrain == "terrain.ply"
    with (tmp_path / "made" / "sites.csv").open() as file:
        for row in csv.DictReader(file):
            # lanes are level across: half of 3.2 m
            expected_m = 0.04 * (float(row["x_m"]) - x0_m)
            assert float(row["ground_m"]) == pytest.approx(expected_m, abs=0.08)


def test_rejects_openstreetmap_with_roads_without_reference_system(tmp_path: Path) -> None:
    small = Path(__file__).parent / "data" / "small.osm"
    with pytest.raises(InputError, match="no reference system"):
        create_scenario(tmp_path / "made", [ROUNDABOUT, small])


def test_outline_of_an_open_mesh_is_the_area_below_its_triangles() -> None:
    """Two houses without floors, 10 m apart: the space between them is free."""
    houses = [block("a", (0, 0, 0), (4, 4, 3)), block("b", (14, 0, 0), (4, 4, 3))]
    vertices_m = np.concatenate([house.vertices_m for house in houses])
    without_floor = _BOX_FACES[2:]
    faces = np.concatenate([without_floor, without_floor + 8])
    mesh = MappedMesh("town", "mesh", vertices_m, faces, is_closed=False)
    assert static_objects.outline(mesh).area == pytest.approx(2 * 16)


def test_point_cloud_replaces_what_it_contains() -> None:
    counts = ImportCounts()
    solids = [MappedSolid("way/1", "barrier", box(0, 0, 9, 1), 2.0, "default"),
              MappedSolid("way/2", "barrier", box(50, 0, 59, 1), 2.0, "default")]  # fmt: skip
    for solid in solids:
        counts.keep(solid)
    survey = MappedMesh(
        "s", "as_built", np.array([[-1.0, -1, 1], [20, -1, 1], [-1, 20, 1]]), np.array([[0, 1, 2]]), False
    )
    rest = static_objects._without_replaced(
        SolidMap(tuple(solids), counts=counts), static_objects.StaticObjects(meshes=(survey,))
    )
    assert [solid.name for solid in rest.solids] == ["way/2"]
    assert rest.counts.objects == {"barrier": 1}
