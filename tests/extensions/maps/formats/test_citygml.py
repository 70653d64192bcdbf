"""CityGML: which surfaces of an object are used, its heights, templates, relief, and what is rejected."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.extensions.maps.formats.city_objects import CityObject, select_footprint, select_surfaces
from egvs.extensions.maps.formats.citygml import CityGmlFile, is_citygml, read_relief
from tests.extensions.maps.formats.small_city_models import (
    box,
    box_rings,
    city_model,
    city_object,
    multi_surface,
    nest,
    polygon,
    solid,
    write_model,
)

SQUARE = [(0.0, 0.0, 0.0), (4.0, 0.0, 0.0), (4.0, 4.0, 0.0), (0.0, 4.0, 0.0)]
LOW, HIGH = (0.0, 0.0, 3.0), (10.0, 20.0, 15.5)


def read(folder: Path, *members: str, **options: str) -> list[CityObject]:
    return list(CityGmlFile(write_model(folder / "a.gml", *members, **options)).objects())


def lod(level: int, form: str, content: str) -> str:
    return f"<x:lod{level}{form}>{content}</x:lod{level}{form}>"


def test_recognises_city_model_in_any_encoding() -> None:
    text = city_model()
    assert is_citygml(text.encode()) and is_citygml(text.encode("utf-16"))
    assert is_citygml(b"<CityModel>") and not is_citygml(b"<osm><CityModelX/></osm>")


def test_reads_one_box_with_undeclared_prefix(tmp_path: Path) -> None:
    (building,) = read(tmp_path, city_object("Building", "b1", lod(1, "Solid", solid(box(LOW, HIGH)))))
    assert (building.name, building.kind, building.lod) == ("b1", "Building", 1.0)
    assert building.srs_name.endswith("6677")
    surfaces = select_surfaces(building).surfaces
    assert [len(surface.rings[0]) for surface in surfaces] == [5] * 6
    expected = [[*ring, ring[0]] for ring in box_rings(LOW, HIGH)]
    np.testing.assert_array_equal([surface.rings[0] for surface in surfaces], expected)


def test_highest_level_is_used_and_its_references_followed(tmp_path: Path) -> None:
    names = [f"p{number}" for number in range(6)]
    walls = [polygon(ring, name=name) for name, ring in zip(names, box_rings(LOW, HIGH), strict=True)]
    boundaries = [nest(multi_surface([wall]), "boundedBy", "WallSurface", "lod2MultiSurface") for wall in walls]
    references = lod(2, "Solid", solid([f"#{name}" for name in names]))
    coarse = lod(1, "Solid", solid(box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))))
    (building,) = read(tmp_path, city_object("Building", "b", coarse, references, *boundaries))
    selection = select_surfaces(building)
    assert building.lod == 2.0
    assert len(selection.surfaces) == 6 and selection.unresolved == 0
    assert max(surface.rings[0][:, 2].max() for surface in selection.surfaces) == 15.5


def test_boundary_surfaces_stand_in_for_a_solid_with_broken_references(tmp_path: Path) -> None:
    wall = multi_surface([polygon(SQUARE, name="p")])
    boundary = nest(wall, "boundedBy", "RoofSurface", "lod2MultiSurface")
    (building,) = read(tmp_path, city_object("Building", "b", lod(2, "Solid", solid(["#gone", "#p"])), boundary))
    selection = select_surfaces(building)
    assert (len(selection.surfaces), selection.unresolved) == (1, 1)


def test_closure_surfaces_are_open(tmp_path: Path) -> None:
    closure = nest(multi_surface([polygon(SQUARE, name="c")]), "boundedBy", "ClosureSurface", "lod2MultiSurface")
    wall = nest(multi_surface([polygon(SQUARE, name="w")]), "boundedBy", "WallSurface", "lod2MultiSurface")
    references = lod(2, "Solid", solid(["#c", "#w"]))
    (with_solid,) = read(tmp_path, city_object("Building", "b", references, closure, wall))
    (without,) = read(tmp_path, city_object("Building", "b", closure, wall))
    for building in (with_solid, without):
        selection = select_surfaces(building)
        assert (len(selection.surfaces), selection.unresolved) == (1, 0)


def test_reversed_surface_is_turned(tmp_path: Path) -> None:
    inner = f"<gml:baseSurface>{polygon(SQUARE)}</gml:baseSurface>"
    turned = f'<gml:OrientableSurface orientation="-">{inner}</gml:OrientableSurface>'
    (building,) = read(tmp_path, city_object("Building", "b", lod(2, "MultiSurface", multi_surface([turned]))))
    ring = select_surfaces(building).surfaces[0].rings[0]
    np.testing.assert_array_equal(ring, [*SQUARE, SQUARE[0]][::-1])


def test_parts_and_installations_use_their_own_level(tmp_path: Path) -> None:
    square = multi_surface([polygon(SQUARE)])
    part = nest(solid(box(LOW, HIGH)), "consistsOfBuildingPart", "BuildingPart", "lod1Solid")
    outer = nest(square, "outerBuildingInstallation", "BuildingInstallation", "lod3Geometry")
    roof = nest(square, "boundedBy", "RoofSurface", "lod2MultiSurface")
    (building,) = read(tmp_path, city_object("Building", "b", roof, part, outer))
    assert len(building.components) == 3
    assert len(select_surfaces(building).surfaces) == 1 + 6 + 1


def test_interiors_and_appearances_are_skipped(tmp_path: Path) -> None:
    room = nest(solid(box(LOW, HIGH)), "interiorRoom", "Room", "lod4Solid")
    theme = "<x:appearance><x:Appearance><x:target>#p</x:target></x:Appearance></x:appearance>"
    (building,) = read(
        tmp_path, city_object("Building", "b", room, theme, lod(1, "MultiSurface", multi_surface([polygon(SQUARE)])))
    )
    assert building.lod == 1.0
    assert len(select_surfaces(building).surfaces) == 1


def test_citygml_3_boundaries_and_heights(tmp_path: Path) -> None:
    height = "<x:height><x:Height><x:highReference>top</x:highReference><x:value>12.5</x:value></x:Height></x:height>"
    wall = nest(multi_surface([polygon(SQUARE)]), "boundary", "WallSurface", "lod2MultiSurface")
    (building,) = read(tmp_path, city_object("Building", "b", height, wall))
    assert building.measured_height_m() == 12.5
    assert len(select_surfaces(building).surfaces) == 1


@pytest.mark.parametrize(
    ("text", "expected"),
    [("12.5", 12.5), (" 3 ", 3.0), ("-9999", None), ("9999", None), ("0", None), ("high", None), ("nan", None)],
)
def test_impossible_measured_heights_are_unknown(tmp_path: Path, text: str, expected: float | None) -> None:
    (building,) = read(tmp_path, city_object("Building", "b", f"<x:measuredHeight>{text}</x:measuredHeight>"))
    assert building.measured_height_m() == expected


def test_heights_of_generic_attributes_are_not_those_of_the_building(tmp_path: Path) -> None:
    generic = '<gen:measureAttribute name="h"><gen:height>99</gen:height></gen:measureAttribute>'
    storeys = "<x:storeysAboveGround>4</x:storeysAboveGround>"
    (building,) = read(tmp_path, city_object("Building", "b", generic, storeys))
    assert (building.measured_height_m(), building.storeys()) == (None, 4.0)


def test_footprint_is_preferred_to_roof_edge(tmp_path: Path) -> None:
    edge = lod(0, "RoofEdge", multi_surface([polygon([(x + 9, y, z) for x, y, z in SQUARE])]))
    foot = lod(0, "FootPrint", multi_surface([polygon(SQUARE)]))
    (building,) = read(tmp_path, city_object("Building", "b", edge, foot))
    assert select_surfaces(building).surfaces == []
    assert select_footprint(building)[0].rings[0][:, 0].max() == 4.0


def test_template_may_come_after_its_use(tmp_path: Path) -> None:
    matrix = "<core:transformationMatrix>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</core:transformationMatrix>"
    point = "<core:referencePoint><gml:Point><gml:pos>5 6 7</gml:pos></gml:Point></core:referencePoint>"

    def lamp(name: str, geometry: str) -> str:
        return city_object(
            "CityFurniture",
            name,
            lod(
                1, "ImplicitRepresentation", f"<core:ImplicitGeometry>{matrix}{geometry}{point}</core:ImplicitGeometry>"
            ),
        )

    reference = '<core:relativeGMLGeometry xlink:href="#t"/>'
    inline = f"<core:relativeGMLGeometry>{multi_surface([polygon(SQUARE)], name='t')}</core:relativeGMLGeometry>"
    file = CityGmlFile(write_model(tmp_path / "a.gml", lamp("first", reference), lamp("second", inline)))
    first, second = file.objects()
    assert select_surfaces(first).placements[0].template == "t"
    assert select_surfaces(first).placements[0].point == [5.0, 6.0, 7.0]
    assert len(select_surfaces(second).placements[0].template) == 1
    assert len(file.templates["t"]) == 1
    assert select_surfaces(first).surfaces == []


def test_references_in_a_circle_end(tmp_path: Path) -> None:
    first = multi_surface(["#b", "#b"], name="a")
    second = multi_surface(["#a", "#a", polygon(SQUARE)], name="b")
    (building,) = read(
        tmp_path, city_object("Building", "x", lod(2, "MultiSurface", first), lod(2, "MultiSurface", second))
    )
    assert len(select_surfaces(building).surfaces) == 1


def test_exponential_references_are_followed_once(tmp_path: Path) -> None:
    groups = [lod(2, "MultiSurface", multi_surface([f"#g{n + 1}"] * 10, name=f"g{n}")) for n in range(30)]
    groups.append(lod(2, "MultiSurface", multi_surface([polygon(SQUARE)], name="g30")))
    (building,) = read(tmp_path, city_object("Building", "x", *groups))
    assert len(select_surfaces(building).surfaces) == 1


def test_two_dimensional_and_old_coordinates(tmp_path: Path) -> None:
    ring = "<gml:posList>0 0 1 0 1 1 0 0</gml:posList>"
    flat = f'<gml:Polygon srsDimension="2">{nest(ring, "exterior", "LinearRing")}</gml:Polygon>'
    ring = "<gml:coordinates>0,0,5 1,0,5 1,1,5 0,0,5</gml:coordinates>"
    old = f"<gml:Polygon>{nest(ring, 'outerBoundaryIs', 'LinearRing')}</gml:Polygon>"
    points = "".join(f"<gml:pos>{x} {y} 7</gml:pos>" for x, y in [(0, 0), (1, 0), (1, 1), (0, 0)])
    single = f"<gml:Polygon>{nest(points, 'exterior', 'LinearRing')}</gml:Polygon>"
    surfaces = multi_surface([flat, old, single])
    (building,) = read(tmp_path, city_object("Building", "b", lod(1, "MultiSurface", surfaces)))
    heights = [surface.rings[0][:, 2].tolist() for surface in select_surfaces(building).surfaces]
    assert heights == [[0.0] * 4, [5.0] * 4, [7.0] * 4]


def test_reads_gzip_and_other_encodings(tmp_path: Path) -> None:
    text = city_model(city_object("Building", "建物", lod(1, "MultiSurface", multi_surface([polygon(SQUARE)]))))
    (tmp_path / "a.gml").write_bytes(gzip.compress(text.encode()))
    (tmp_path / "b.gml").write_bytes(text.replace("UTF-8", "Shift_JIS").encode("cp932"))
    (tmp_path / "c.gml").write_bytes(text.replace("UTF-8", "UTF-16").encode("utf-16"))
    for name in "abc":
        assert [item.name for item in CityGmlFile(tmp_path / f"{name}.gml").objects()] == ["建物"]


SOUND = city_model(city_object("Building", "b1", lod(1, "Solid", solid(box(LOW, HIGH)))))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("15.5", "nan", "a.gml: b1: posList: expected finite coordinates"),
        ("15.5", "1e400", "a.gml: b1: posList: expected finite coordinates"),
        ("15.5", "1_5", "a.gml: b1: posList: expected numbers"),
        ("15.5", "abc", "a.gml: b1: posList: expected numbers .*abc"),
        (" 15.5", "", r"a.gml: b1: posList: expected 3 numbers for each point, got 10 numbers"),
        ("</core:CityModel>", "", "a.gml: is not well-formed XML"),
        ("<gml:boundedBy>", '<!DOCTYPE x [<!ENTITY a "b">]><gml:boundedBy>', "a.gml: is not well-formed XML"),
        ("<core:CityModel", '<!DOCTYPE x [<!ENTITY a "b">]><core:CityModel', "a.gml: declares XML entities"),
        ("<gml:boundedBy>", "&lol;<gml:boundedBy>", "a.gml: is not well-formed XML: undefined entity"),
        ("<gml:boundedBy>", "<a>" * 200, "a.gml: elements are nested more than 100 deep"),
        ("core:CityModel", "core:Town", "a.gml: expected the root element <CityModel>, got <Town>"),
    ],
)  # fmt: skip
def test_rejects_damaged_file(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in SOUND
    (tmp_path / "a.gml").write_text(SOUND.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        list(CityGmlFile(tmp_path / "a.gml").objects())


def test_rejects_empty_file(tmp_path: Path) -> None:
    (tmp_path / "a.gml").write_bytes(b"")
    with pytest.raises(InputError, match=r"a.gml: is not well-formed XML: no element found"):
        list(CityGmlFile(tmp_path / "a.gml").objects())


def test_rejects_mixed_reference_systems(tmp_path: Path) -> None:
    other = polygon(SQUARE).replace("<gml:Polygon", '<gml:Polygon srsName="EPSG:6668"')
    with pytest.raises(InputError, match=r"a.gml: b: srsName: expected one reference system, got .*6677.*6668"):
        read(tmp_path, city_object("Building", "b", lod(1, "MultiSurface", multi_surface([polygon(SQUARE), other]))))


def test_rejects_long_texts_and_tags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_ELEMENT_MB", "1")
    with pytest.raises(InputError, match="has a tag or text of more than 1 MB"):
        read(tmp_path, city_object("Building", "b", lod(1, "MultiSurface", multi_surface([polygon(SQUARE * 50_000)]))))
    (tmp_path / "a.gml").write_text(f'<CityModel a="{"x" * 2_000_000}"/>', encoding="utf-8")
    with pytest.raises(InputError, match="has a tag or text of more than 1 MB"):
        list(CityGmlFile(tmp_path / "a.gml").objects())


def test_rejects_an_object_with_too_many_surfaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_MAX_TRIANGLES", "1000")
    with pytest.raises(InputError, match=r"a.gml: b: has too many surfaces"):
        read(tmp_path, city_object("Building", "b", lod(1, "MultiSurface", multi_surface([polygon(SQUARE)] * 300))))


# ---- relief


def relief(*triangles: str, patches: str = "trianglePatches") -> str:
    surface = f"<gml:TriangulatedSurface><gml:{patches}>{''.join(triangles)}</gml:{patches}></gml:TriangulatedSurface>"
    content = nest(polygon(SQUARE), "extent") + nest(surface, "tin")
    component = nest(content, "reliefComponent", "TINRelief")
    return city_object("ReliefFeature", "r", "<x:lod>1</x:lod>", component)


UP = [(0.0, 0.0, 1.0), (1.0, 0.0, 2.0), (0.0, 1.0, 3.0)]
"""North, east, height: counter-clockwise in this order means clockwise from above."""

OTHER = [(1.0, 0.0, 2.0), (1.0, 1.0, 4.0), (0.0, 1.0, 3.0)]


@pytest.mark.parametrize("patches", ["trianglePatches", "patches"])
def test_relief_is_turned_up_and_merged(tmp_path: Path, patches: str) -> None:
    triangles = [polygon(ring, tag="Triangle") for ring in (UP, OTHER[::-1])]
    path = write_model(tmp_path / "dem.gml", relief(*triangles, patches=patches))
    vertices, faces, crs = read_relief(path)
    assert crs is not None and crs.endswith("6677")
    assert vertices.tolist() == [[0, 0, 1], [0, 1, 2], [1, 0, 3], [1, 1, 4]]
    a, b, c = (vertices[faces[:, corner], :2] for corner in range(3))
    doubled = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert doubled.tolist() == [1.0, 1.0]


def test_relief_outside_bounds_is_left_out(tmp_path: Path) -> None:
    far = [(x + 100, y, z) for x, y, z in UP]
    path = write_model(tmp_path / "dem.gml", relief(*(polygon(ring, tag="Triangle") for ring in (UP, far))))
    assert len(read_relief(path).faces) == 2
    near = read_relief(path, lambda crs: (-1, 99, 2, 102))  # x is east, the second coordinate of the file
    assert near.vertices[:, 1].min() == 100.0 and len(near.faces) == 1
    assert len(read_relief(path, lambda crs: (500, 500, 501, 501)).faces) == 0


def test_relief_without_triangles_is_rejected(tmp_path: Path) -> None:
    path = write_model(tmp_path / "dem.gml", city_object("Building", "b"))
    with pytest.raises(InputError, match=r"dem.gml: the file has no triangles of terrain. Use a file with TINRelief"):
        read_relief(path)
    path = write_model(tmp_path / "dem.gml", relief(polygon(SQUARE, tag="Triangle")))
    with pytest.raises(InputError, match="expected a triangle, got 4 corners and 0 holes"):
        read_relief(path)
