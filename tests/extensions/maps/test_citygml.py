"""Static objects from CityGML in the world frame: positions, heights, the window, tiles, and real buildings."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import shapely

from egvs.core.errors import InputError
from egvs.creation.map_parts import DEFAULT_BUILDING_M, Alignment, MapContext
from egvs.extensions.maps.buildings import citygml, cityjson
from egvs.extensions.maps.formats.city_objects import select_surfaces
from egvs.extensions.maps.formats.citygml import CityGmlFile
from egvs.formats.georeference import WorldFrame
from tests.extensions.maps.formats.small_city_models import (
    Point,
    box,
    box_rings,
    city_object,
    multi_surface,
    nest,
    polygon,
    solid,
    write_model,
)

SHARED = Path(__file__).parents[4] / "shared" / "real" / "plateau_buildings.gml"

ORIGIN = (-7000.0, -51000.0)
"""East and north in EPSG:6677 of the origin of the tests' world frame."""

FRAME = WorldFrame("EPSG:6677", (-ORIGIN[0], -ORIGIN[1]))
CONTEXT = MapContext(FRAME, shapely.box(-300, -300, 300, 300))


def at(east_m: float, north_m: float, z_m: float) -> Point:
    """A point of EPSG:6677, whose first axis points north."""
    return (ORIGIN[1] + north_m, ORIGIN[0] + east_m, z_m)


def box_at(east_m: float, north_m: float, z_m: float = 3.0, height_m: float = 12.5) -> list[str]:
    """A house of 10 m to the east and 20 m to the north, faces outwards in a right-handed frame."""
    faces = box_rings((east_m, north_m, z_m), (east_m + 10, north_m + 20, z_m + height_m))
    return [polygon([at(*corner) for corner in face]) for face in faces]


def house(name: str, east_m: float, north_m: float, **options: float) -> str:
    return city_object("Building", name, nest(solid(box_at(east_m, north_m, **options)), "lod1Solid"))


def test_house_is_where_it_is_and_as_high_as_it_is(tmp_path: Path) -> None:
    path = write_model(tmp_path / "a.gml", house("h", 100, 50))
    result = citygml.read_solids([path], CONTEXT)
    (mesh,) = result.meshes
    assert (mesh.name, mesh.kind, mesh.is_closed) == ("h", "building", True)
    np.testing.assert_allclose(mesh.vertices_m.min(axis=0), [100, 50, 3], atol=1e-6)
    np.testing.assert_allclose(mesh.vertices_m.max(axis=0), [110, 70, 15.5], atol=1e-6)
    assert result.has_absolute_heights and result.solids == ()
    assert result.counts.heights == {"building": {"geometry": 1}}
    a, b, c = (mesh.vertices_m[mesh.faces[:, corner]] for corner in range(3))
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(10 * 20 * 12.5)


@pytest.mark.slow
def test_degrees_give_the_same_house(tmp_path: Path) -> None:
    lon_lat = FRAME.to_degrees(np.array([[100.0, 50.0], [110.0, 50.0], [110.0, 70.0], [100.0, 70.0]]))
    ring = [(lat, lon, 3.25) for lon, lat in lon_lat.tolist()]
    surface = nest(multi_surface([polygon(ring)]), "lod1MultiSurface")
    path = write_model(
        tmp_path / "a.gml", city_object("Building", "h", surface), srs_name="http://www.opengis.net/def/crs/EPSG/0/6697"
    )
    (mesh,) = citygml.read_solids([path], CONTEXT).meshes
    np.testing.assert_allclose(mesh.vertices_m.min(axis=0), [100, 50, 3.25], atol=1e-5)
    np.testing.assert_allclose(mesh.vertices_m.max(axis=0), [110, 70, 3.25], atol=1e-5)


@pytest.mark.parametrize(
    "srs_name", ["urn:adv:crs:ETRS89_UTM32*DE_DHHN92_NH", "urn:ogc:def:crs,crs:EPSG::25832,crs:EPSG::5783",
                 "http://www.opengis.net/gml/srs/epsg.xml#25832", "EPSG:25832"],
)  # fmt: skip
def test_german_names_of_reference_systems(tmp_path: Path, srs_name: str) -> None:
    context = MapContext(WorldFrame("EPSG:25832", (-500_000.0, -5_600_000.0)), shapely.box(-50, -50, 50, 50))
    ring = [(500_000.0, 5_600_000.0, 9.0), (500_010.0, 5_600_000.0, 9.0), (500_010.0, 5_600_020.0, 9.0)]
    surface = nest(multi_surface([polygon(ring)]), "lod1MultiSurface")
    path = write_model(tmp_path / "a.gml", city_object("Building", "h", surface), srs_name=srs_name)
    (mesh,) = citygml.read_solids([path], context).meshes
    np.testing.assert_allclose(mesh.vertices_m.max(axis=0), [10, 20, 9], atol=1e-6)


def test_objects_outside_the_window_are_left_out(tmp_path: Path) -> None:
    path = write_model(tmp_path / "a.gml", house("near", 0, 0), house("far", 400, 0))
    result = citygml.read_solids([path], CONTEXT)
    assert [mesh.name for mesh in result.meshes] == ["near"]
    assert result.counts.dropped == {"out_of_range": {"building": 1}}
    for east_m, distance in ((1300, "1000 m"), (335, "35 m"), (250_000, "more than 100 km")):
        path = write_model(tmp_path / "b.gml", house("far", east_m, 0))
        (note,) = citygml.read_solids([path], CONTEXT).notes
        assert (
            note == f"b.gml: none of its 1 object is within reach of the sensors; the nearest is {distance} beyond it."
        )


@pytest.mark.slow
def test_alignment_places_a_model_in_a_system_that_proj_does_not_know(tmp_path: Path) -> None:
    """A triangle 30 m long and 9 high, in metres and in feet."""
    ring = [(0.0, 0.0, 9.0), (30.0, 0.0, 9.0), (30.0, 30.0, 9.0)]
    surface = nest(multi_surface([polygon(ring)]), "lod1MultiSurface")
    path = write_model(tmp_path / "a.gml", city_object("Building", "h", surface), srs_name="Local")
    points = np.array([[0.0, 0.0], [30.0, 0.0]])
    for unit_m in (1.0, 0.3048):
        alignment = Alignment(points, points * unit_m, unit_m)
        (mesh,) = citygml.read_solids([path], MapContext(FRAME, CONTEXT.window, alignment)).meshes
        np.testing.assert_allclose(mesh.vertices_m.max(axis=0), np.array([30, 30, 9]) * unit_m, atol=1e-9)
    with pytest.raises(InputError, match=r"unknown coordinate reference system 'Local'.* Or: Give two of its points"):
        citygml.read_solids([path], CONTEXT)


@pytest.mark.slow
def test_swapped_axes_are_an_error(tmp_path: Path) -> None:
    lon, lat = FRAME.to_degrees(np.array([[0.0, 0.0]]))[0].tolist()
    ring = [(lon, lat, 1.0), (lon + 1e-4, lat, 1.0), (lon, lat + 1e-4, 2.0)]
    surface = nest(multi_surface([polygon(ring)]), "lod1MultiSurface")
    path = write_model(tmp_path / "a.gml", city_object("Building", "h", surface), srs_name="EPSG:6668")
    message = r"a.gml: .* cannot be converted|in the order longitude, latitude, 1 would be"
    with pytest.raises(InputError, match=message):
        citygml.read_solids([path], CONTEXT)
    swapped = polygon([(east, north, z) for north, east, z in [at(0, 0, 0), at(9, 0, 0), at(9, 9, 0)]])
    surface = nest(multi_surface([swapped]), "lod1MultiSurface")
    path = write_model(tmp_path / "b.gml", city_object("Building", "h", surface))
    with pytest.raises(InputError, match=r"b.gml: no object is within reach.*in the order east, north, 1 would be"):
        citygml.read_solids([path], CONTEXT)


def test_heights_of_footprints(tmp_path: Path) -> None:
    def foot(name: str, east_m: float, height: str) -> str:
        ring = [at(east_m + x, y, 2.0) for x, y in ((0, 0), (5, 0), (5, 5), (0, 5))]
        return city_object("Building", name, height, nest(multi_surface([polygon(ring)]), "lod0FootPrint"))

    path = write_model(
        tmp_path / "a.gml",
        foot("measured", 0, "<x:measuredHeight>7.5</x:measuredHeight><x:storeysAboveGround>9</x:storeysAboveGround>"),
        foot("storeys", 10, "<x:measuredHeight>-9999</x:measuredHeight><x:storeysAboveGround>4</x:storeysAboveGround>"),
        foot("unknown", 20, ""),
    )
    result = citygml.read_solids([path], CONTEXT)
    heights = {item.name: (item.height_m, item.height_source, item.base_m) for item in result.solids}
    assert heights == {
        "measured": (7.5, "height", 0.0),
        "storeys": (12.0, "levels", 0.0),
        "unknown": (DEFAULT_BUILDING_M, "default", 0.0),
    }
    assert result.counts.heights == {"building": {"height": 1, "levels": 1, "default": 1}}
    assert [item.geometry.area for item in result.solids] == pytest.approx([25.0] * 3)


def implicit(name: str, point: Point, geometry: str, matrix: str = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1") -> str:
    content = f"<x:transformationMatrix>{matrix}</x:transformationMatrix>{geometry}"
    position = " ".join(map(repr, point))
    content += f"<x:referencePoint><gml:Point><gml:pos>{position}</gml:pos></gml:Point></x:referencePoint>"
    return city_object("CityFurniture", name, nest(content, "lod3ImplicitRepresentation", "ImplicitGeometry"))


TEMPLATE = nest(multi_surface(box((0.0, 0.0, 0.0), (1.0, 2.0, 5.0)), name="t"), "relativeGMLGeometry")
"""1 m along the first axis, 2 m along the second, 5 m high."""

REFERENCE = '<x:relativeGMLGeometry xlink:href="#t"/>'


def test_templates_are_placed_along_the_axes_of_the_file(tmp_path: Path) -> None:
    doubled = "2 0 0 0 0 2 0 0 0 0 2 1 0 0 0 1"
    path = write_model(
        tmp_path / "a.gml",
        implicit("before", at(-50, 10, 4), REFERENCE),
        implicit("inline", at(20, 30, 3), TEMPLATE),
        implicit("large", at(60, 30, 3), REFERENCE, doubled),
        implicit("lost", at(60, 30, 3), '<x:relativeGMLGeometry xlink:href="#none"/>'),
        implicit("library", at(60, 30, 3), "<x:libraryObject>../lamp.dae</x:libraryObject>"),
    )
    result = citygml.read_solids([path], CONTEXT)
    meshes = {mesh.name: mesh for mesh in result.meshes}
    assert sorted(meshes) == ["before", "inline", "large"]
    # the first axis of the system points north
    np.testing.assert_allclose(meshes["inline"].vertices_m.min(axis=0), [20, 30, 3], atol=1e-6)
    np.testing.assert_allclose(meshes["inline"].vertices_m.max(axis=0), [22, 31, 8], atol=1e-6)
    np.testing.assert_allclose(meshes["before"].vertices_m.max(axis=0), [-48, 11, 9], atol=1e-6)
    np.testing.assert_allclose(meshes["large"].vertices_m.min(axis=0), [60, 30, 4], atol=1e-6)
    np.testing.assert_allclose(meshes["large"].vertices_m.max(axis=0), [64, 32, 14], atol=1e-6)
    assert result.counts.dropped == {"no_surface": {"furniture": 2}}
    assert "1 template is in other files, which are not read." in result.notes
    assert "1 reference leads to no surface in the same object." in result.notes


@pytest.mark.slow
def test_templates_at_degrees_keep_their_size(tmp_path: Path) -> None:
    lon, lat = FRAME.to_degrees(np.array([[20.0, 30.0]]))[0].tolist()
    path = write_model(tmp_path / "a.gml", implicit("lamp", (lat, lon, 3.0), TEMPLATE), srs_name="EPSG:6697")
    result = citygml.read_solids([path], CONTEXT)
    (mesh,) = result.meshes
    np.testing.assert_allclose(mesh.vertices_m.min(axis=0), [20, 30, 3], atol=2e-3)
    np.testing.assert_allclose(mesh.vertices_m.max(axis=0), [21, 32, 8], atol=2e-3)
    assert "1 template is placed at degrees; axes are taken as metres east, north and up." in result.notes


def test_kinds_of_objects(tmp_path: Path) -> None:
    square = [at(x, y, 2.0) for x, y in ((0, 0), (9, 0), (9, 9), (0, 9))]
    cover = nest(multi_surface([polygon(square)]), "lod1MultiSurface")
    path = write_model(
        tmp_path / "a.gml",
        city_object("Bridge", "b", nest(solid(box_at(0, 0)), "lod1Solid")),
        city_object("CityFurniture", "f", nest(multi_surface(box_at(20, 0)), "lod1Geometry")),
        city_object("SolitaryVegetationObject", "t", nest(multi_surface(box_at(40, 0)), "lod2Geometry")),
        city_object("PlantCover", "p", "<x:averageHeight>1.5</x:averageHeight>", cover),
        city_object("PlantCover", "q", nest(nest(solid(box_at(60, 0)), "solidMember"), "lod2MultiSolid")),
        city_object("Road", "r", cover),
        city_object("LandUse", "l", cover),
    )
    result = citygml.read_solids([path], CONTEXT)
    kinds = {mesh.name: mesh.kind for mesh in result.meshes}
    assert kinds == {"b": "bridge", "f": "furniture", "t": "vegetation", "q": "vegetation"}
    assert [(item.name, item.kind, item.height_m) for item in result.solids] == [("p", "vegetation", 1.5)]
    assert result.counts.not_modelled == {"Road": 1, "LandUse": 1}


def test_open_buildings_are_named_and_degenerate_rings_counted(tmp_path: Path) -> None:
    flat = polygon([at(0, 0, 0), at(1, 0, 0), at(2, 0, 0)])
    content = nest(multi_surface([*box_at(0, 0)[:5], flat]), "lod1MultiSurface")
    path = write_model(tmp_path / "a.gml", city_object("Building", "open", content), house("closed", 20, 20))
    result = citygml.read_solids([path], CONTEXT)
    assert [mesh.is_closed for mesh in result.meshes] == [False, True]
    assert result.notes == (
        "building: 2 at LOD 1.",
        "1 of 2 meshes of the kind building is not closed, so a point inside cannot be recognised: open.",
        "1 ring without area was left out.",
    )


def test_file_without_system_needs_an_alignment(tmp_path: Path) -> None:
    content = nest(solid(box((0.0, 0.0, 0.0), (10.0, 20.0, 5.0))), "lod1Solid")
    path = write_model(tmp_path / "a.gml", city_object("Building", "h", content), srs_name="")
    with pytest.raises(InputError, match=r"a.gml: h: the file declares no coordinate reference system. .*--align"):
        citygml.read_solids([path], CONTEXT)
    alignment = Alignment(np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([[100.0, 0.0], [100.0, 10.0]]))
    context = MapContext(FRAME, CONTEXT.window, alignment)
    (mesh,) = citygml.read_solids([path], context).meshes
    np.testing.assert_allclose(mesh.vertices_m.min(axis=0), [80, 0, 0], atol=1e-9)
    np.testing.assert_allclose(mesh.vertices_m.max(axis=0), [100, 10, 5], atol=1e-9)


def test_unknown_system_is_rejected(tmp_path: Path) -> None:
    content = nest(solid(box_at(0, 0)), "lod1Solid")
    path = write_model(tmp_path / "a.gml", city_object("Building", "h", content), srs_name="EPSG:999999")
    with pytest.raises(InputError, match=r"a.gml: h: srsName: unknown coordinate reference system 'EPSG:999999'"):
        citygml.read_solids([path], CONTEXT)


def test_only_tiles_in_reach_are_opened(tmp_path: Path) -> None:
    """The origin, at 35.540 N, 139.756 E, is in the square 53392640."""
    folder = tmp_path / "udx" / "bldg"
    folder.mkdir(parents=True)
    write_model(folder / "53392640_bldg_6697_op.gml", house("here", 0, 0))
    (folder / "53394525_bldg_6697_op.gml").write_text("damaged, 20 km away")
    (folder / "53392640_dem_6697_op.gml").write_text("damaged, no solids")
    result = citygml.read_solids([tmp_path], CONTEXT)
    assert [mesh.name for mesh in result.meshes] == ["here"]
    assert result.notes[-1].startswith("2 of 3 CityGML files were not opened")
    (folder / "53392640_frn_6697_op.gml").write_text("damaged, in reach")
    with pytest.raises(InputError, match=r"53392640_frn_6697_op.gml: is not well-formed XML"):
        citygml.read_solids([tmp_path], CONTEXT)


def test_object_in_two_tiles_is_used_once(tmp_path: Path) -> None:
    first = write_model(tmp_path / "a.gml", house("h", 0, 0))
    second = write_model(tmp_path / "b.gml", house("h", 0, 0), house("i", 20, 0))
    third = write_model(tmp_path / "c.gml", house("i", 40, 0))
    result = citygml.read_solids([first, second, third], CONTEXT)
    assert [mesh.name for mesh in result.meshes] == ["h", "i", "i#2"]
    assert result.counts.dropped == {"duplicate": {"building": 1}}


def test_too_many_triangles_are_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_model(
        tmp_path / "a.gml",
        implicit("t", at(0, 0, 0), TEMPLATE),
        *(implicit(f"i{n}", at(0, 0, 0), REFERENCE) for n in range(99)),
    )
    monkeypatch.setenv("EGVS_MAX_TRIANGLES", "1000")
    with pytest.raises(InputError, match=r"makes too many triangles with the objects before it. The limit is 1,000"):
        citygml.read_solids([path], CONTEXT)


# ---- real buildings

CENTRE_DEG = np.array([[139.777, 35.54]])


@pytest.fixture(scope="module")
def real() -> tuple[MapContext, citygml.SolidMap]:
    if not SHARED.is_file():
        pytest.skip(f"{SHARED.name} is not beside the checkout (shared/real)")
    east, north = WorldFrame("EPSG:32654").from_lon_lat(CENTRE_DEG)[0].tolist()
    context = MapContext(WorldFrame("EPSG:32654", (-east, -north)), shapely.box(-500, -500, 500, 500))
    return context, citygml.read_solids([SHARED], context)


@pytest.mark.slow
def test_real_buildings_and_their_heights(real: tuple[MapContext, citygml.SolidMap]) -> None:
    _, result = real
    heights = {mesh.name[4:8]: float(np.ptp(mesh.vertices_m[:, 2])) for mesh in result.meshes}
    assert len(result.meshes) == 8 and result.counts.heights == {"building": {"geometry": 8}}
    # In the file, the roof of this building is at 19.66144493 (also the top of the envelope), its ground at 3.654.
    tallest = next(mesh for mesh in result.meshes if mesh.name.startswith("BLD_ae7f"))
    assert tallest.vertices_m[:, 2].max() == 19.66144493
    assert heights["ae7f"] == pytest.approx(16.1, abs=0.15), "measuredHeight"
    assert heights["8a3e"] == pytest.approx(3.9, abs=0.15), "measuredHeight"
    assert result.notes == ("building: 8 at LOD 2.",), "all are closed"


def test_real_buildings_are_where_they_are(real: tuple[MapContext, citygml.SolidMap]) -> None:
    """The south-west corner of the file's envelope, by plain arithmetic: metres of a degree at 35.54 N."""
    _, result = real
    west, south = np.concatenate([mesh.vertices_m[:, :2] for mesh in result.meshes]).min(axis=0)
    assert west == pytest.approx((139.77492484 - 139.777) * 90_660, abs=2.0)
    assert south == pytest.approx((35.53821315 - 35.54) * 110_940, abs=2.0)


def test_every_edge_of_the_real_solids_is_passed_in_both_directions() -> None:
    """Of the rings in the file, without any triangulation or conversion."""
    if not SHARED.is_file():
        pytest.skip(f"{SHARED.name} is not beside the checkout (shared/real)")
    for building in CityGmlFile(SHARED).objects():
        edges = set()
        for surface in select_surfaces(building).surfaces:
            for ring in surface.rings:
                points = list(map(tuple, ring.tolist()))
                edges |= {(a, b) for a, b in itertools.pairwise(points) if a != b}
        assert edges == {(b, a) for a, b in edges}, building.name


# ---- CityJSON


def city_json(version: str = "2.0", **changes: object) -> dict[str, object]:
    """A house of 10 m to the east, 20 m to the north; millimetres; a lamp from a template; a part."""
    faces = box_rings((0, 0, 3000), (10_000, 20_000, 15_500))
    corners = sorted({corner for face in faces for corner in face})
    shell = [[[corners.index(corner) for corner in face]] for face in faces]
    # the first axis of EPSG:6677 points north
    vertices = [[int(north), int(east), int(z)] for east, north, z in corners]
    lod: object = 1 if version == "1.0" else "1.2"
    template = {"type": "MultiSurface", "lod": lod, "boundaries": [[[0, 1, 2]]]}
    matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    instance = {"type": "GeometryInstance", "template": 0, "boundaries": [0], "transformationMatrix": matrix}
    house = {"type": "Building", "attributes": {"measuredHeight": 12.4}, "children": ["part"], "geometry": [
        {"type": "MultiSurface", "lod": 0 if version == "1.0" else "0", "boundaries": [shell[0]]}]}  # fmt: skip
    part = {"type": "BuildingPart", "parents": ["house"], "geometry": [
        {"type": "Solid", "lod": lod, "boundaries": [shell]}]}  # fmt: skip
    document: dict[str, object] = {
        "type": "CityJSON",
        "version": version,
        "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/6677"},
        "transform": {"scale": [0.001] * 3, "translate": [ORIGIN[1] + 50, ORIGIN[0] + 100, 0]},
        "CityObjects": {
            "part": part, "house": house, "lamp": {"type": "CityFurniture", "geometry": [instance]},
            "road": {"type": "Road", "geometry": []},
        },
        "vertices": vertices,
        "geometry-templates": {"templates": [template], "vertices-templates": [[0, 0, 0], [1, 0, 0], [0, 1, 2]]},
    }  # fmt: skip
    return document | changes


@pytest.mark.parametrize("version", ["1.0", "1.1", "2.0"])
def test_reads_cityjson(tmp_path: Path, version: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps(city_json(version)))
    result = cityjson.read_solids([path], CONTEXT)
    house, lamp = result.meshes
    assert (house.name, house.kind, house.is_closed) == ("house", "building", True)
    np.testing.assert_allclose(house.vertices_m.min(axis=0), [100, 50, 3], atol=1e-6)
    np.testing.assert_allclose(house.vertices_m.max(axis=0), [110, 70, 15.5], atol=1e-6)
    np.testing.assert_allclose(lamp.vertices_m.max(axis=0), [101, 51, 5], atol=1e-6)
    assert result.counts.not_modelled == {"Road": 1}


def test_cityjson_footprint_has_the_measured_height(tmp_path: Path) -> None:
    document = city_json()
    objects = document["CityObjects"]
    assert isinstance(objects, dict)
    del objects["part"]
    (tmp_path / "a.json").write_text(json.dumps(document))
    (solid_,) = cityjson.read_solids([tmp_path / "a.json"], CONTEXT).solids
    assert (solid_.name, solid_.height_m, solid_.height_source) == ("house", 12.4, "height")
    assert solid_.geometry.area == pytest.approx(200.0)


def test_closure_surfaces_of_cityjson_are_open(tmp_path: Path) -> None:
    document = city_json()
    objects = document["CityObjects"]
    assert isinstance(objects, dict)
    surfaces = [{"type": "WallSurface"}, {"type": "ClosureSurface"}]
    objects["part"]["geometry"][0]["semantics"] = {"surfaces": surfaces, "values": [[0, 0, 1, None, 0, 0]]}
    (tmp_path / "a.json").write_text(json.dumps(document))
    house = cityjson.read_solids([tmp_path / "a.json"], CONTEXT).meshes[0]
    assert (len(house.faces), house.is_closed) == (10, False)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": "3.0"}, "version: expected 1.0 to 2.0, got '3.0'"),
        ({"type": "City"}, 'expected a CityJSON object'),
        ({"vertices": [[0, 0]]}, r"vertices: 0: expected three finite numbers, got \[0, 0\]"),
        ({"vertices": [[0, 0, 0]]}, "boundaries: expected vertex numbers from 0 to 0, got"),
        ({"transform": {"scale": [1e305] * 3, "translate": [0, 0, 0]}}, "transform: its scale makes .* infinite"),
        ({"transform": {"scale": [1e-3, 1e-3, 1e30], "translate": [ORIGIN[1], ORIGIN[0], 0]}},
         "house: expected coordinates within 1e.08 m, got z = 3e.33"),
        ({"transform": 3}, "transform: expected scale and translate"),
        ({"metadata": []}, "metadata: expected an object"),
        ({"CityObjects": {"a": {"type": "Building", "children": ["b"]}, "b": {"type": "Building", "children": ["a"]}}},
         "a: children: is a part of itself"),
        ({"CityObjects": {"a": {"type": "Building", "geometry": [{"type": "Solid", "lod": "9", "boundaries": []}]}}},
         "lod: expected a level of detail"),
        ({"CityObjects": {"a": {"type": "Building", "geometry": [{"type": "Solid", "lod": "1", "boundaries": [3]}]}}},
         "boundaries: expected nested lists"),
        ({"geometry-templates": None}, "template: expected the number of a template, got 0"),
    ],
)  # fmt: skip
def test_rejects_damaged_cityjson(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    (tmp_path / "a.json").write_text(json.dumps(city_json(**changes)))  # type: ignore[arg-type]
    with pytest.raises(InputError, match=message):
        cityjson.read_solids([tmp_path / "a.json"], CONTEXT)


def test_rejects_json_that_is_truncated_or_too_deep(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps(city_json())[:-20])
    with pytest.raises(InputError, match=r"a.json: is not valid JSON"):
        cityjson.read_solids([path], CONTEXT)
    path.write_text('{"type": "CityJSON", "version": "2.0", "a": ' + "[" * 200 + "]" * 200 + "}")
    with pytest.raises(InputError, match="nested more than 100 deep"):
        cityjson.read_solids([path], CONTEXT)
