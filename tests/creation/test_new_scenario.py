"""New scenarios from other maps than OpenStreetMap, and from several maps."""

import csv
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pyproj import CRS
from shapely.geometry import box

from egvs.core.errors import InputError
from egvs.core.readers import Reader
from egvs.creation import alignment, static_objects, sumo_network
from egvs.creation.map_parts import ImportCounts, MapContext, MappedMesh, MappedSolid, SolidMap
from egvs.creation.map_readers import MapFile, find_reader
from egvs.creation.new_scenario import assumed_sizes, scenario_notes
from egvs.creation.road_source import NetworkRoads
from egvs.creation.static_objects import REPLACED
from egvs.formats import meshes
from egvs.scenario import loading
from egvs.sensors import sites
from egvs.world.terrain import TerrainSurface
from tests.creation.new_scenarios import create_scenario
from tests.installed import needs
from tests.traffic.helpers import netgenerate

SCENARIOS = Path(__file__).parents[2] / "scenarios"
ROUNDABOUT = SCENARIOS / "roundabout" / "network.net.xml"
SMALL = Path(__file__).parent / "data" / "small.osm"
HILL = SCENARIOS / "hill" / "network.net.xml"

_CORNERS = np.array([[x, y, z] for z in (0.0, 1.0) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], dtype=np.float64)
_BOX_FACES = np.array([
    [0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4],
    [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7],
])  # fmt: skip


def block(name: str, low_m: Sequence[float], size_m: Sequence[float]) -> MappedMesh:
    """A box as a closed mesh."""
    return MappedMesh(name, "building", _CORNERS * size_m + low_m, _BOX_FACES, True)


@dataclass(frozen=True)
class GivenMap(MapFile):
    """A map file whose reader returns a given map."""

    solid_map: SolidMap

    @property
    def module(self) -> SimpleNamespace:
        return SimpleNamespace(read_solids=lambda paths, context: self.solid_map)


def reader(name: str, solid_map: SolidMap) -> MapFile:
    return GivenMap(Path(f"{name}.map"), Reader(name, "map", "given", gives=("solids",)), solid_map)


def collect(*maps: MapFile, zero_height_m: float | None = None, **options: Any) -> static_objects.StaticObjects:
    """Collect objects around the roundabout, whose lanes lie within 50 m of 0, 0."""
    roads = NetworkRoads.read(sumo_network.read_roads(ROUNDABOUT, sumo_network.RoadOptions()), ROUNDABOUT)
    context = MapContext(None, box(-300, -300, 300, 300), streets=roads.streets)
    read = static_objects.read_maps(maps, roads, MapFile(ROUNDABOUT, find_reader(ROUNDABOUT)), context)
    return static_objects.collect_objects(read, roads.streets, (0.0, 0.0), zero_height_m, **options)


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.parametrize("option", ["lefthand", "righthand", "walk"])
def test_network_has_its_own_side_and_sidewalks(tmp_path: Path, option: str) -> None:
    with pytest.raises(InputError, match=f"--{option}"):
        create_scenario(tmp_path / "made", ROUNDABOUT, **{option: True})
    assert not (tmp_path / "made").exists()


@pytest.mark.slow
def test_network_is_cut_on_request(tmp_path: Path) -> None:
    """What is left in the square is within a centimetre of where it was; the junction and its region are the same."""
    grid = netgenerate(tmp_path / "map", "--grid", "--grid.number", "4", "--grid.length", "120", name="grid.net.xml")
    whole = create_scenario(tmp_path / "whole", grid, at=(120.0, 120.0))
    cut = create_scenario(tmp_path / "cut", grid, at=(120.0, 120.0), surroundings_m=130.0)
    assert (cut.junction.id, cut.region.roi) == (whole.junction.id, whole.region.roi)
    before, after = ({edge.id: edge for edge in made.streets.network.edges} for made in (whole, cut))
    assert after.keys() < before.keys()
    for name, edge in after.items():
        for lane, lane_before in zip(edge.lanes, before[name].lanes, strict=True):
            near = (np.abs(lane.shape_m[:, :2] - 120.0) < 130.0).all(
                axis=1
            )  # roads end where their junction is cut off
            np.testing.assert_allclose(lane.shape_m[near], lane_before.shape_m[near], atol=0.011)
    assert "The network is cut 130 m from the junction." in cut.notes


def test_heights_above_sea_level_are_lowered_to_the_ground() -> None:
    meshes = (block("a", (60, 60, 40.0), (10, 10, 6)), block("b", (80, 60, 40.5), (10, 10, 20)))
    (summary,) = (objects := collect(reader("city", SolidMap(meshes=meshes, has_absolute_heights=True)))).maps
    assert [mesh.vertices_m[:, 2].min() for mesh in objects.meshes] == pytest.approx([-0.25, 0.25])
    assert summary.height_range_m == pytest.approx((5.75, 20.25))
    lowest = "the height of the lowest points of the objects nearest to the junction"
    assert summary.notes[0] == f"40.25 m, {lowest}, is subtracted from the heights in the map."
    assert objects.zero_height_m == 40.25


def slope(rise: float) -> TerrainSurface:
    """A ground that rises by this much per metre to the east; 0 at x = 0."""
    corners = np.array([[x, y, rise * x] for x, y in ((-300, -300), (300, -300), (300, 300), (-300, 300))], dtype=float)
    return TerrainSurface(corners, np.array([[0, 1, 2], [0, 2, 3]]), corners[0, :2], corners[2, :2])


def test_meshes_above_the_ground_stand_on_the_slope() -> None:
    """Parts of one file keep their heights to each other; those of the other file stand 10 m further up the slope."""
    wall, roof = block("wall", (95, 60, 0), (10, 10, 6)), block("roof", (97, 60, 6), (8, 10, 1))
    house = tuple(replace(part, group="house") for part in (wall, roof))
    shed = block("shed", (195, 60, 0), (10, 10, 3))
    objects = collect(reader("meshes", SolidMap(meshes=(*house, shed))), ground=slope(0.1))
    bases_m = [mesh.vertices_m[:, 2].min() for mesh in objects.meshes]
    assert bases_m == pytest.approx([10.0, 16.0, 20.0])
    assert (
        objects.maps[0].notes[0]
        == "house: 10.00 m, the height of the ground below its middle, is added to its heights."
    )


def test_space_of_vehicles_counts_from_the_sloping_ground() -> None:
    """At x = -40 m, the lanes lie 8 m below z = 0: a sign at z = -2 m is above the vehicles, one at z = -7 m is not."""
    high = replace(block("high", (-42, -2, -2.0), (4, 4, 0.5)), kind="furniture")
    low = replace(block("low", (-42, -2, -7.0), (4, 4, 0.5)), kind="furniture")
    absolute = SolidMap(meshes=(high, low), has_absolute_heights=True)
    notes = collect(reader("city", absolute), zero_height_m=0.0, ground=slope(0.2)).maps[0].notes
    assert notes[-1] == "1 of 2 objects stands in lanes; check the position of the map: low."


def test_heights_from_surface_model_count_as_known_for_neighbours() -> None:
    """The surface model ends at x = 200 m; beyond it, the median of three buildings in it is taken."""
    solids = tuple(
        MappedSolid(f"s{x}", "building", box(x, 100, x + 10, 110), 9.0, "default") for x in (150, 165, 180, 205)
    )
    counts = ImportCounts()
    for solid in solids:
        counts.keep(solid)
    model = static_objects.SurfaceModel(Plane(20.0), Plane(8.0))
    objects = collect(reader("footprints", SolidMap(solids, counts=counts)), surface_model=model)
    assert [(solid.height_m, solid.height_source) for solid in objects.solids] == [
        (12.0, "surface model"), (12.0, "surface model"), (12.0, "surface model"), (12.0, "neighbours"),
    ]  # fmt: skip
    assert scenario_notes(True, objects.counts) == [
        "4 of 4 buildings have neither height nor levels: the median height of the buildings near by assumed for 1,"
        " the surface model above the terrain used for 3."
    ]


class Plane:
    """A height west of x = 200 m."""

    notes = ()

    def __init__(self, height_m: float) -> None:
        self._height_m = height_m

    def height_m(self, xy_m: np.ndarray) -> np.ndarray:
        return np.where(xy_m[:, 0] < 200, self._height_m, np.nan)


def test_buildings_without_a_height_get_that_of_their_neighbours() -> None:
    known = [block(f"m{n}", (100.0 + 20 * n, 100, 0), (10, 10, 12.0 + n)) for n in range(3)]
    unknown = MappedSolid("x", "building", box(100, 130, 110, 140), 9.0, "default")
    counts = ImportCounts()
    counts.keep(unknown)
    footprints = reader("footprints", SolidMap((unknown,), counts=counts))
    objects = collect(reader("city", SolidMap(meshes=tuple(known))), footprints)
    assert [(solid.height_m, solid.height_source) for solid in objects.solids] == [(13.0, "neighbours")]
    assert objects.counts.heights["building"] == {"neighbours": 1}
    assert "1 of 1 building has neither height nor levels: the median" in scenario_notes(True, objects.counts)[0]
    assert assumed_sizes(objects.counts) == ["heights of 1 of 1 building"]


def test_mesh_in_lanes_is_reported() -> None:
    beside, above, inside = (
        block("beside", (100, 100, 0), (9, 9, 9)),
        block("above", (-2, -60, 6), (4, 4, 1)),
        block("inside", (-2, -60, 1), (4, 4, 1)),
    )
    assert collect(reader("one", SolidMap(meshes=(beside, above)))).maps[0].notes == ()
    (note,) = collect(reader("two", SolidMap(meshes=(beside, above, inside)))).maps[0].notes
    assert note == "1 of 3 objects stands in lanes; check the position of the map: inside."


def test_footprint_is_cut_at_the_carriageway() -> None:
    solid = MappedSolid("x", "building", box(-40, -60, 40, -50), 8.0, "height")
    objects = collect(reader("footprints", SolidMap((solid,), counts=ImportCounts())))
    assert objects.counts.cut["building"] == 1
    assert sum(part.area.area for part in objects.solids) < solid.area.area


@pytest.mark.slow
def test_building_of_another_map_replaces_that_of_openstreetmap(tmp_path: Path) -> None:
    small = Path(__file__).parent / "data" / "small.osm"
    plain = create_scenario(tmp_path / "plain", small)
    n_buildings = plain.statics.counts.objects["building"]
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
        ([((0, 0), (0, 0)), ((10, 0), (11, 0))], "10.00 apart in the file and 11.00 m on the ground"),
        ([((0, 0), (0, 0)), ((0, 0), (0, 0))], "0.00 apart"),
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


@pytest.mark.slow
@needs("maps")
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


@pytest.mark.slow
@pytest.mark.system
def test_network_that_sumo_rejects_is_named(tmp_path: Path, run_egvs) -> None:
    network = tmp_path / "roads.net.xml"
    text, count = re.subn(
        r'<tlLogic ([^>]*)type="[a-z_]+"', r'<tlLogic \1type="none_such"', HILL.read_text(encoding="utf-8")
    )
    assert count
    network.write_text(text, encoding="utf-8")
    code, _, error = run_egvs("new", tmp_path / "made", "--from", network)
    assert code == 2 and f"{network}: SUMO cannot simulate the network: " in error and "none_such" in error
    assert not (tmp_path / "made").exists()


@pytest.mark.slow
@pytest.mark.system
@needs("maps")
def test_maps_that_cover_all_kerbs_are_named(tmp_path: Path) -> None:
    ring = [[9.99, 51.99], [10.01, 51.99], [10.01, 52.01], [9.99, 52.01], [9.99, 51.99]]
    outline = {"type": "Feature", "properties": {"height": 9}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    (tmp_path / "hall.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [outline]}))
    with pytest.raises(InputError, match=r"no free location for a pole .*: the objects of .*hall.geojson.* cover them"):
        create_scenario(tmp_path / "made", [SMALL, tmp_path / "hall.geojson"])
    assert not (tmp_path / "made").exists()


@pytest.mark.slow
@pytest.mark.system
@needs("maps")
def test_slope_surface_model_and_mesh_in_one_scenario(tmp_path: Path, run_egvs) -> None:
    """On a plane that rises by 5 % to the north; the surface model is 12 m higher, and 3 m on the northern house."""
    made = tmp_path / "made"
    for name, above_m in (("terrain", 0.0), ("surface", 12.0)):
        rows = [[f"{100 + 0.05 * (520 - 20 * row - 10) + above_m:.3f}"] * 26 for row in range(26)]
        east_m, north_m = 568648, 5761510
        head = f"ncols 26\nnrows 26\nxllcorner {east_m - 260}\nyllcorner {north_m - 260}\ncellsize 20\n"
        (tmp_path / f"{name}.asc").write_text(head + "\n".join(" ".join(row) for row in rows))
        (tmp_path / f"{name}.prj").write_text("EPSG:32632")
    import trimesh

    boxes = [trimesh.creation.box((4, 4, 4), trimesh.transformations.translation_matrix((x, 60, 2))) for x in (60, 80)]
    trimesh.util.concatenate(boxes).export(tmp_path / "sheds.obj")
    maps = [SMALL, tmp_path / "terrain.asc", tmp_path / "sheds.obj"]
    align = ("--align", "0,0=52.0,10.0", "--align", "0,100=52.000899,10.0")
    code, printed, error = run_egvs(
        "new", made, "--from", *maps, *align, "--surface", tmp_path / "surface.asc", "--vehicles-per-hour", "200"
    )
    assert code == 0, error
    scenario = loading.load(made)
    assert scenario.crs.zero_height_m == pytest.approx(113.0, abs=0.1)  # 260 m north of the grid's corner
    features = json.loads((made / "statics.geojson").read_text())["features"]
    heights = [f["properties"] for f in features if f["properties"].get("height_from") == "surface model"]
    assert heights and {round(properties["height_m"], 2) for properties in heights} == {12.0}
    vertices_m = meshes.load_clean_mesh(made / "mesh.ply", 1e6)[0].vertices
    assert vertices_m[:, 2].min() == pytest.approx(3.0, abs=0.1)  # 60 m north of the junction
    code, checked, error = run_egvs("check", made)
    solids = re.search(r"\((\d+) solids with", printed)
    assert code == 0 and solids is not None, error
    assert f"{solids[1]} solids" in checked


@pytest.mark.slow
@needs("maps")
def test_mesh_in_feet_is_converted_to_metres(tmp_path: Path, run_egvs) -> None:
    """A shed of 20 feet beside the junction; the points of --align are 328.08 feet apart."""
    import trimesh

    shed = trimesh.creation.box((20, 20, 20), trimesh.transformations.translation_matrix((200, 200, 10)))
    shed.export(tmp_path / "shed.obj")
    align = ("--align", "0,0=52.0,10.0", "--align", "0,328.08=52.000899,10.0")
    code, printed, error = run_egvs("new", tmp_path / "made", "--from", SMALL, tmp_path / "shed.obj", *align)
    assert code == 0, error
    assert "note: The distance between the points of --align agrees in feet" in printed
    vertices_m = meshes.load_clean_mesh(tmp_path / "made" / "mesh.ply", 1e6)[0].vertices
    np.testing.assert_allclose(
        np.ptp(vertices_m, axis=0), 20 * 0.3048, atol=0.1
    )  # turned from true north to the grid's


@pytest.mark.slow
def test_lists_junctions_and_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_egvs) -> None:
    monkeypatch.chdir(tmp_path)
    code, printed, progress = run_egvs("new", "--from", SMALL, "--list")
    assert code == 0, progress
    row = next(line.split() for line in printed.splitlines() if "East Street" in line)
    assert row[:4] == ["52.00000,10.00000", "4", "4", "yes"]
    assert [line.split(maxsplit=2)[2] for line in progress.splitlines()] == [
        "opens the maps", "reads the roads", "lists the junctions"
    ]  # fmt: skip
    assert not list(tmp_path.iterdir())
    for option in ("--track-crs", "--track-columns", "--pedestrian-tracks", "--overpass"):
        assert f"{option}: has no effect with --list" in run_egvs("new", "--list", "--from", SMALL, option, "any")[2]
    assert "FOLDER: no folder is given" in run_egvs("new", "--from", SMALL)[2]
    assert "no map is given" in run_egvs("new", "--list")[2]
    code, _, message = run_egvs("new", tmp_path / "place", "--from", SMALL, "--list")
    assert (code, "place: there is no such map, and --list makes no folder" in message) == (2, True)


@pytest.mark.slow
def test_lists_the_nearest_junctions_of_a_point_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_egvs
) -> None:
    """Three crossings of one road, 278, 0 and 556 m west of the point (111.3 km per degree on the equator)."""
    write_crossroads(tmp_path / "three.osm", [9.9975, 10.0, 9.995])
    at = ("--at", "0.0,10.0")
    code, printed, error = run_egvs("new", "--from", tmp_path / "three.osm", "--list", *at)
    assert code == 0, error
    rows = [line.split() for line in printed.splitlines()[1:4]]
    assert [row[0] for row in rows] == ["0.00000,10.00000", "0.00000,9.99750", "0.00000,9.99500"]
    assert [int(row[1]) for row in rows] == pytest.approx([0, 278, 556], abs=15)  # to the edge of the junction
    monkeypatch.setattr("egvs.creation.new_scenario.MOST_LISTED_NEARBY", 2)
    assert "2 junctions" in run_egvs("new", "--from", tmp_path / "three.osm", "--list", *at)[1]
    assert "outside the extract" in run_egvs("new", "--from", tmp_path / "three.osm", "--list", "--at", "60,10")[2]


def write_crossroads(path: Path, lons_deg: list[float]) -> None:
    """Write a map of a road along the equator, crossed by one road at each longitude."""
    middle = {number: lon_deg for number, lon_deg in enumerate(sorted([9.99, *lons_deg, 10.005]), 1)}
    nodes = [(number, 0.0, lon_deg) for number, lon_deg in middle.items()]
    ways = [(100, "Equator Road", list(middle))]
    for number, lon_deg in list(middle.items())[1:-1]:
        nodes += [(number + 10, 0.002, lon_deg), (number + 20, -0.002, lon_deg)]
        ways.append((100 + number, f"Road {number}", [number + 10, number, number + 20]))
    lines = [f'<node id="{number}" version="1" lat="{lat}" lon="{lon}"/>' for number, lat, lon in nodes]
    for number, name, refs in ways:
        refs_text = "".join(f'<nd ref="{ref}"/>' for ref in refs)
        tags = f'<tag k="highway" v="secondary"/><tag k="name" v="{name}"/>'
        lines.append(f'<way id="{number}" version="1">{refs_text}{tags}</way>')
    path.write_text(f'<osm version="0.6">{"".join(lines)}</osm>', encoding="utf-8")


@pytest.mark.slow
def test_roads_without_buildings_and_trees_assume_open_surroundings(tmp_path: Path) -> None:
    roads = SMALL.read_text().replace('k="building', 'k="was_building').replace('v="tree', 'v="former_tree')
    (tmp_path / "roads.osm").write_text(roads)
    for name, is_assumed in ((SMALL, False), (tmp_path / "roads.osm", True)):
        create_scenario(tmp_path / f"out_{is_assumed}", name)
        assumed = loading.load(tmp_path / f"out_{is_assumed}").assumed
        assert ("surroundings (no building or tree is known)" in assumed) is is_assumed
