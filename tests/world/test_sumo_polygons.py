"""Shapes of a SUMO .poly.xml are solid if their type is, with their own heights; all others are counted.

Shapes are squares of whole metres, so that volumes can be computed by hand.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.core.sumo_home import sumo_home
from egvs.formats import osm
from egvs.formats.georeference import Georeference, WorldFrame
from egvs.scenario.loading import scenario_from_dict
from egvs.traffic.network import read_location
from egvs.world import footprints, static_world, sumo_polygons
from egvs.world.footprints import FootprintFile
from egvs.world.geolocation import StatedLocation, network_world_frame
from egvs.world.map_features import SolidTypes
from egvs.world.mesh import World
from egvs.world.sumo_polygons import read_poly_xml

SMALL = Path(__file__).parents[1] / "creation" / "data" / "small.osm"
SQUARE = "0,0 4,0 4,4 0,4"
HERE = Roi((0.0, 0.0, 0.0), (20.0, 20.0, 5.0))
NOWHERE = Georeference(None, HERE, "scenario.toml")
FRAME = WorldFrame("EPSG:32632", (-550_700.0, -5_635_200.0))
UTM = "+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"


def poly(
    kind: str | None, shape: str = SQUARE, fill: str = "1", tags: dict[str, str] | None = None, **more: str
) -> str:
    given = {"type": kind, "fill": fill, "shape": shape} | more
    attributes = " ".join(f'{key}="{value}"' for key, value in given.items() if value is not None)
    params = "".join(f'<param key="{key}" value="{value}"/>' for key, value in (tags or {}).items())
    return f'<poly id="x" {attributes}>{params}</poly>'


def read(
    folder: Path, *shapes: str, types: dict[str, Any] | None = None, height_m: float = 9.0,
    world: Georeference = NOWHERE,
) -> FootprintFile:  # fmt: skip
    path = folder / "s.poly.xml"
    path.write_text(f"<additional>{''.join(shapes)}</additional>", encoding="utf-8")
    return read_poly_xml(path, SolidTypes(types), height_m, world)


def extents(file: FootprintFile) -> list[tuple[str, float, float, float]]:
    """Kind, underside, top and area of each footprint."""
    return [(f.kind, f.base_m, f.height_m, round(f.polygon.area, 6)) for f in file.footprints]


# ---- which are solid


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("building", ("building", 0.0, 9.0, 16.0)),
        ("building.yes", ("building", 0.0, 9.0, 16.0)),
        ("building.garage", ("building", 0.0, 2.5, 16.0)),
        ("building.garages.row", ("building", 0.0, 2.5, 16.0)),
        ("building.shed", ("building", 0.0, 2.5, 16.0)),
        ("building.hut", ("building", 0.0, 2.5, 16.0)),
        ("building.kiosk", ("building", 0.0, 3.0, 16.0)),
        ("building.greenhouse", ("building", 0.0, 3.0, 16.0)),
        ("building.roof", ("roof", 4.5, 5.0, 16.0)),
        ("building.carport", ("roof", 2.2, 2.5, 16.0)),
        ("man_made.chimney", ("man_made", 0.0, 9.0, 16.0)),
        ("barrier.wall", ("barrier", 0.0, 2.0, 16.0)),
        ("barrier", ("barrier", 0.0, 1.5, 16.0)),
        ("wall", ("wall", 0.0, 2.0, 16.0)),
        ("natural.tree", ("tree_crown", 2.4, 8.0, 16.0)),
    ],
)
def test_heights_of_solid_types(tmp_path: Path, kind: str, expected: tuple[str, float, float, float]) -> None:
    assert extents(read(tmp_path, poly(kind))) == [pytest.approx(expected)]


@pytest.mark.parametrize(
    "kind",
    [
        *("parking", "amenity.parking", "landuse", "residential", "landuse.forest", "forest", "park", "leisure.garden"),
        *("water", "natural", "natural.water", "shop", "amenity", "tourism", "historic", "man_made", "man_made.pier"),
        *("building.no", "building.demolished", "building.underground", "barrier.kerb", "barrier.gate", "school"),
    ],
)
def test_counts_types_that_are_not_solid(tmp_path: Path, kind: str) -> None:
    file = read(tmp_path, poly("building", "9,9 10,9 10,10"), poly(kind), poly(kind, "7,7 8,8", fill="0"))
    assert len(file.footprints) == 1
    assert file.ignored == {f"polygons of type {kind}": 2}
    assert not file.warnings


def test_knows_all_types_of_polyconvert() -> None:
    """Those that its own type file makes, under the names that it gives by default and with the full ones."""
    from defusedxml.ElementTree import parse

    types = SolidTypes()
    home = sumo_home()
    for element in parse(home / "data" / "typemap" / "osmPolyconvert.typ.xml").getroot():
        assert types.is_known(element.get("id")) or element.get("id") == "inner", element.get("id")
        assert types.is_known(element.get("name")) or element.get("name") == "inner", element.get("name")


def test_warns_about_unknown_types(tmp_path: Path) -> None:
    file = read(tmp_path, poly("building"), poly("sculpture"), poly("sculpture"), poly(None), poly("mine.own"))
    assert len(file.footprints) == 1
    assert file.ignored == {
        "polygons of type sculpture": 2,
        "polygons of type (none)": 1,
        "polygons of type mine.own": 1,
    }
    assert [(w.rule, w.is_error) for w in file.warnings] == [("polygon types", False)]
    assert str(file.warnings[0]) == (
        f"{tmp_path / 's.poly.xml'}: polygons of unknown types were left out: sculpture (2), (none) (1), mine.own (1). "
        'Set each in [statics.polygon_types] to "solid", "ignore" or a height in metres.'
    )


def test_warns_about_file_without_solids(tmp_path: Path) -> None:
    file = read(tmp_path, poly("parking"), poly("landuse"))
    assert [w.problem for w in file.warnings] == ["none of the 2 polygons is solid"]


def test_accepts_invalid_shapes_that_are_not_solid(tmp_path: Path) -> None:
    assert not read(tmp_path, poly("landuse", "0,0 4,4 4,0 0,4"), poly("landuse", "")).footprints


def test_keeps_all_parts_of_crossing_outline(tmp_path: Path) -> None:
    """A bow tie: two triangles of 4 m2 that meet at (2, 2). What encloses nothing is left out."""
    square = poly("building", "10,0 14,0 14,4 10,4")
    file = read(tmp_path, poly("building", "0,0 4,4 4,0 0,4"), poly("building", "0,0 4,0 8,0"), square)
    assert [footprint.polygon.area for footprint in file.footprints] == [4.0, 4.0, 16.0]
    assert file.repaired["rings that cross themselves, each part that they enclose kept"] == 1
    assert file.ignored["outlines that enclose nothing of type building"] == 1
    (warning,) = file.warnings
    assert warning.problem == "outlines that cross themselves: 1 (x). All areas that they enclose are kept"


# ---- the user's own table


@pytest.mark.parametrize(
    ("types", "kind", "top_m"),
    [
        ({"parking": 12.0}, "parking", 12.0),
        ({"parking": "solid"}, "parking", 9.0),
        ({"building": "ignore"}, "building.garage", None),
        ({"building": "ignore", "building.garage": "solid"}, "building.garage", 2.5),
        ({"building": "ignore", "building.garage": "solid"}, "building.church", None),
        ({"building": 15.0}, "building.church", 15.0),
        ({"building": 15.0}, "building.garage", 2.5),
        ({"building.garage": 3.5}, "building.garage", 3.5),
        ({"building.no": 5.0}, "building.no", 5.0),
        ({"building.no": 5.0}, "building.demolished", None),
        ({"": "solid"}, "sculpture", 9.0),
        ({"": 3.0}, None, 3.0),
        ({"": 3.0}, "parking", None),
        ({"": "ignore"}, "sculpture", None),
        ({"landuse": "solid"}, "landuse.forest", 9.0),
    ],
)
def test_polygon_types_override_tables(
    tmp_path: Path, types: dict[str, Any], kind: str | None, top_m: float | None
) -> None:
    file = read(tmp_path, poly("fence"), poly(kind), types=types)
    assert [f.height_m for f in file.footprints[1:]] == ([] if top_m is None else [top_m])
    assert not file.warnings


def test_roof_with_user_height_stays_open(tmp_path: Path) -> None:
    assert extents(read(tmp_path, poly("building.roof"), types={"building.roof": 6.0})) == [("roof", 5.5, 6.0, 16.0)]


def load(folder: Path, **settings: Any) -> Any:
    values = {
        "roi": {"center_m": [20, 20, 2.5], "size_m": [80, 80, 5], "voxel_m": 0.5},
        "traffic": {"fcd": "none.csv"},
        "sites": {"file": "sites.csv"},
        "statics": {"ground": False, **settings},
    }
    return scenario_from_dict(values, folder, "scenario.toml")


def test_accepts_types_without_quotes(tmp_path: Path) -> None:
    nested = {"building": {"shed": 2.2, "yes": {"old": "ignore"}}, "parking": "solid"}
    flat = {"building.shed": 2.2, "building.yes.old": "ignore", "parking": "solid"}
    assert load(tmp_path, polygon_types=nested).statics.polygon_types == flat


@pytest.mark.parametrize("value", ["yes", -1.0, 0, True, None, [3.0]])
def test_rejects_invalid_polygon_type(tmp_path: Path, value: Any) -> None:
    with pytest.raises(
        InputError, match=r'statics.polygon_types: expected "solid", "ignore" or a height .* for "building.shed", got'
    ):
        load(tmp_path, polygon_types={"building.shed": value})


def test_build_world_counts_and_warns(tmp_path: Path) -> None:
    (tmp_path / "s.poly.xml").write_text(
        f"<additional>{poly('building')}{poly('parking')}{poly('odd')}</additional>", encoding="utf-8"
    )
    settings = {"polygons": ["s.poly.xml"], "polygon_height_m": 4.0}
    world, counts = static_world.build_world(load(tmp_path, **settings))
    assert volumes(world) == pytest.approx([64.0])
    summary = counts.to_json()
    assert summary["built"] == {"building": 1}
    assert summary["left_out"] == {"polygons of type odd": 1, "polygons of type parking": 1}
    assert [warning["rule"] for warning in summary["warnings"]] == ["polygon types"]
    _, quiet = static_world.build_world(load(tmp_path, **settings, polygon_types={"odd": "ignore"}))
    assert "warnings" not in quiet.to_json()


def volumes(world: World) -> np.ndarray:
    """Signed volume of each solid."""
    t = world.triangles_m
    each = (t[:, 0] * np.cross(t[:, 1], t[:, 2])).sum(axis=1) / 6
    return np.bincount(world.solid_of_face, weights=each, minlength=len(world.solids))


# ---- heights


@pytest.mark.parametrize(
    ("kind", "tags", "attributes", "base_top"),
    [
        ("building", {}, {"height": "5.00"}, (0, 5)),  # polyconvert writes the map's height so
        ("building", {"height": "3"}, {}, (0, 3)),
        ("building", {"height": "12 m"}, {}, (0, 12)),
        ("building", {"height": "tall"}, {"height": "5"}, (0, 5)),
        ("building.garage", {"height": "4"}, {}, (0, 4)),
        ("building", {"building:levels": "3"}, {}, (0, 9)),
        ("building", {"building:levels": "3", "roof:levels": "2"}, {}, (0, 15)),
        ("building", {"building:levels": "3", "roof:levels": "2", "roof:height": "4"}, {}, (0, 13)),
        ("building", {"height": "9", "min_height": "3"}, {}, (3, 9)),
        ("building.roof", {"min_height": "3"}, {}, (3, 5)),
        ("building.roof", {"height": "7"}, {}, (6.5, 7)),
        ("building", {"building": "garage"}, {}, (0, 2.5)),  # what --all-attributes keeps says more than the type
        ("building", {"building": "roof"}, {}, (4.5, 5)),
    ],
)
def test_heights_from_tags_and_attributes(
    tmp_path: Path, kind: str, tags: dict[str, str], attributes: dict[str, str], base_top: tuple[float, float]
) -> None:
    file = read(tmp_path, poly(kind, tags=tags, **attributes))
    assert [(f.base_m, f.height_m) for f in file.footprints] == [pytest.approx(base_top)]
    assert not file.repaired


def test_counts_unreadable_tags(tmp_path: Path) -> None:
    file = read(tmp_path, poly("building", tags={"height": "tall", "building:levels": "2"}))
    assert [f.height_m for f in file.footprints] == [6.0]
    assert file.repaired == {"height that cannot be read, taken as not there": 1}


@pytest.mark.parametrize("height", ["tall", "0", "-3", "nan", "inf"])
def test_rejects_invalid_height_attribute(tmp_path: Path, height: str) -> None:
    with pytest.raises(InputError, match=rf"poly x: height: expected a number of metres above 0, got '{height}'"):
        read(tmp_path, poly("building", height=height))


# ---- lines, courtyards, points


def test_wall_is_strip_and_closed_outline_is_area(tmp_path: Path) -> None:
    file = read(
        tmp_path,
        poly("barrier.wall", "0,0 10,0", fill="0"),
        poly("barrier.wall", "0,0 10,0 10,10 0,10 0,0", fill="0"),  # round a yard: the yard stays open
        poly("building", "0,0 4,0 4,4 0,4 0,0", fill="0"),
    )
    assert extents(file)[0] == ("barrier", 0.0, 2.0, 3.0)
    assert extents(file)[2] == ("building", 0.0, 9.0, 16.0)
    assert not file.footprints[1].polygon.covers(shapely.Point(5, 5))


def test_warns_about_open_outline_of_building(tmp_path: Path) -> None:
    file = read(tmp_path, poly("fence"), poly("building.school", "0,0 4,0 4,4", fill="0"))
    assert file.ignored == {"open lines of type building.school": 1}
    assert [w.problem for w in file.warnings] == ["open outlines of solid types were left out: building.school (1)"]
    assert "--osm.merge-relations" in file.warnings[0].hint


def test_cuts_out_courtyards(tmp_path: Path) -> None:
    outer, inner = "0,0 20,0 20,20 0,20", "5,5 15,5 15,15 5,15"
    shed, far = "6,6 8,6 8,8 6,8", "50,50 52,50 52,52 50,52"
    file = read(
        tmp_path, poly("inner", inner), poly("building", outer), poly("building.shed", shed), poly("building", far),
        poly("inner", far),
    )  # fmt: skip
    assert [area for *_, area in extents(file)] == [300.0, 4.0, 4.0]  # the last is a hole in a wood: it stays
    assert file.repaired == {"courtyards cut out": 1, "heights taken as 9 m": 2}


@pytest.mark.parametrize("color", ["white", "255,255,255"])
def test_cuts_out_white_courtyards(tmp_path: Path, color: str) -> None:
    """With --osm.keep-full-type it has the type of its building; its colour alone tells it."""
    outer, inner = "0,0 20,0 20,20 0,20", "5,5 15,5 15,15 5,15"
    school = "building.school"
    file = read(
        tmp_path, poly(school, inner, color=color), poly(school, outer), poly(school, "50,50 52,50 52,52", color=color)
    )
    assert [area for *_, area in extents(file)] == [300.0, 2.0]
    assert not file.warnings


def test_warns_about_solid_inside_another(tmp_path: Path) -> None:
    """Without --osm.merge-relations, polyconvert fills courtyards."""
    file = read(tmp_path, poly("building", "0,0 20,0 20,20 0,20"), poly("building", "5,5 15,5 15,15 5,15"))
    assert len(file.footprints) == 2
    assert [w.problem for w in file.warnings] == [
        "solids inside another of the same kind and height: 1. They may be filled courtyards"
    ]
    tower = poly("building", "5,5 15,5 15,15 5,15", height="30")
    assert not read(tmp_path, poly("building", "0,0 20,0 20,20 0,20"), tower).warnings


def test_counts_pairs_of_many_solids_in_one_place_up_to_a_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pairs grow with the square of the solids, so a small file would be compared for hours."""
    monkeypatch.setattr(sumo_polygons, "_MAX_COMPARISONS", 15)
    tree = '<poi id="t" type="natural.tree" x="2" y="5"/>'
    (warning,) = read(tmp_path, tree * 5).warnings  # each in four others
    assert "of the same kind and height: at least 15." in str(warning)
    monkeypatch.setattr(sumo_polygons, "_MAX_COMPARISONS", 20)
    (warning,) = read(tmp_path, tree * 5).warnings
    assert "of the same kind and height: 20." in str(warning)


def test_pairs_of_boxes_come_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    shapes = [shapely.box(x, 0, x + 2.5, 1) for x in range(9)]
    expected = set(zip(*shapely.STRtree(shapes).query(shapes).tolist(), strict=True))
    monkeypatch.setattr(footprints, "_PAIRS_AT_ONCE", 20)
    parts = list(footprints.box_pairs(shapes, shapes))
    assert len(parts) == 5
    assert {pair for part in parts for pair in zip(*map(np.ndarray.tolist, part), strict=True)} == expected


def test_reads_trees_and_poles(tmp_path: Path) -> None:
    file = read(
        tmp_path,
        '<poi id="t" type="natural.tree" x="5" y="6"><param key="height" value="10"/></poi>',
        '<poi id="l" type="highway.street_lamp" x="1" y="2"/>',
        '<poi id="s" type="shop.bakery" x="1" y="2"/>',
        '<poi id="b" type="building.yes" x="1" y="2"/>',
        '<poi id="g" type="natural.tree" lon="10"/>',
    )
    assert [(f.name, f.kind, f.base_m, f.height_m) for f in file.footprints] == [
        ("t", "tree_crown", 3.0, 10.0),
        ("t/trunk", "tree_trunk", 0.0, 3.0),
        ("l", "pole", 0.0, 6.0),
    ]
    assert file.footprints[0].polygon.centroid.coords[0] == pytest.approx((5, 6))
    assert file.ignored == {"points of type shop": 1, "points of type building": 1, "points of type natural": 1}


def test_polygon_types_apply_to_points(tmp_path: Path) -> None:
    points = [
        f'<poi id="{i}" type="{kind}" x="{i}" y="2"/>'
        for i, kind in enumerate(("highway.street_lamp", "power.pole", "barrier.bollard", "man_made.mast"))
    ]
    table = {"highway.street_lamp": 4.5, "power": "ignore", "barrier.bollard": "ignore", "man_made.mast": "solid"}
    file = read(tmp_path, *points, types=table)
    assert [(f.name, f.height_m) for f in file.footprints] == [("0", 4.5), ("3", 15.0)]
    assert file.ignored == {"points of type power": 1, "points of type barrier": 1}


def test_drops_duplicate_solids(tmp_path: Path) -> None:
    """With full types, polyconvert writes a tower as a building and as a tower."""
    file = read(tmp_path, poly("building.yes"), poly("man_made.tower"), poly("historic.yes"))
    assert len(file.footprints) == 1
    assert file.repaired == {"solids that are there twice": 1, "heights taken as 9 m": 1}


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ("", "poly x: shape: expected at least three points for an area, two for a line, got ''"),
        ("1,2", "poly x: shape: expected at least three points for an area, two for a line, got '1,2'"),
        ("0,0 a,0 4,4", "poly x: expected shape='x,y x,y ...' in metres"),
        ("0,0 4 4,4", "poly x: expected shape='x,y x,y ...' in metres"),
        ("0,0 nan,0 4,4 0,4", "poly x: geometry: expected finite coordinates"),
        ("0,0 4,0 4,-1e308 0,4 0,0", "poly x: geometry: expected coordinates within 1e\\+08 m, got 1e\\+308 m"),
    ],
)
def test_rejects_invalid_shapes(tmp_path: Path, shape: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read(tmp_path, poly("building", shape))


def test_ignores_underground_garage(tmp_path: Path) -> None:
    file = read(tmp_path, poly("fence"), poly("building.garage", tags={"location": "underground"}))
    assert file.ignored == {"underground polygons of type building.garage": 1}


# ---- where shapes are


def as_geo(shape: str) -> str:
    metres = np.array([[float(v) for v in pair.split(",")] for pair in shape.split()])
    return " ".join(f"{lon:.13f},{lat:.13f}" for lon, lat in FRAME.to_degrees(metres).tolist())


def test_converts_shapes_in_degrees(tmp_path: Path) -> None:
    here = Georeference(FRAME, HERE, "scenario.toml")
    lon, lat = as_geo("10,10").split(",")
    tree = f'<poi id="t" type="natural.tree" lon="{lon}" lat="{lat}"/>'
    tree_m = '<poi id="t" type="natural.tree" x="10" y="10"/>'
    geo = read(tmp_path, poly("building", as_geo(SQUARE), geo="1"), poly("building", "6,0 9,0 9,3"), tree, world=here)
    metres = read(tmp_path, poly("building"), poly("building", "6,0 9,0 9,3"), tree_m, world=here)
    assert [f.polygon.wkb for f in geo.footprints] == [f.polygon.wkb for f in metres.footprints]
    assert len(geo.footprints) == 4
    with pytest.raises(
        InputError, match=r"s.poly.xml: poly x: the shape is in longitude and latitude, but the position of the world"
    ):
        read(tmp_path, poly("building", as_geo(SQUARE), geo="1"))


def test_converts_from_location_of_file(tmp_path: Path) -> None:
    """polyconvert without the scenario's network lays another zero."""
    here = Georeference(FRAME, HERE, "scenario.toml")
    location = f'<location netOffset="-550690.00,-5635195.00" projParameter="{UTM}"/>'
    moved = read(tmp_path, location, poly("building", "10,5 14,5 14,9 10,9"), world=here)
    assert moved.footprints[0].polygon.equals(read(tmp_path, poly("building")).footprints[0].polygon)
    same = f'<location netOffset="-550700.00,-5635200.00" projParameter="{UTM}"/>'
    assert read(tmp_path, same, poly("building"), world=here).footprints[0].polygon.bounds == (0, 0, 4, 4)
    far = f'<location netOffset="-500000.00,-5635200.00" projParameter="{UTM}"/>'
    with pytest.raises(InputError, match=r"s.poly.xml: .* are 51 km .* as metres of its own <location>. .*polyconvert"):
        read(tmp_path, far, poly("building"), world=here)
    with pytest.raises(InputError, match=r"are 141 km from the region of interest"):
        read(tmp_path, poly("building", "100000,100000 100004,100000 100004,100004"))


def stated(offset: str, projection: str = "!") -> str:
    return f'<location netOffset="{offset}" projParameter="{projection}"/>'


def read_with_network(folder: Path, network: str, *shapes: str, world: Georeference = NOWHERE) -> FootprintFile:
    """Shapes beside a network with a ``<location>``."""
    (folder / "n.net.xml").write_text(f"<net>{network}</net>")
    location = read_location(folder / "n.net.xml")
    assert location is not None
    path = folder / "s.poly.xml"
    path.write_text(f"<additional>{''.join(shapes)}</additional>")
    return read_poly_xml(path, SolidTypes({}), 9.0, world, StatedLocation("the network n.net.xml", location))


@pytest.mark.parametrize(
    ("network", "file", "statements"),
    [
        (stated("0.00,0.00"), stated("30.00,0.00"), "netOffset 30,0, but that of the network n.net.xml netOffset 0,0"),
        (stated("0,0"), stated("0,-0.5", ""), "netOffset 0,-0.5, but that of the network n.net.xml netOffset 0,0"),
        (
            stated("0,0"),
            stated("0,0", UTM),
            f"netOffset 0,0 and projParameter '{UTM}',"
            " but that of the network n.net.xml netOffset 0,0 and no projection",
        ),
        (stated("5,5", "-"), stated("5,6", "-"), "netOffset 5,6, but that of the network n.net.xml netOffset 5,5"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("is_last", [False, True])
def test_rejects_other_location_that_cannot_be_converted(
    tmp_path: Path, network: str, file: str, statements: str, is_last: bool
) -> None:
    """Without a projection on both sides, nobody knows whether both offsets count from the same origin."""
    elements = [poly("building"), file] if is_last else [file, poly("building")]
    with pytest.raises(InputError) as error:
        read_with_network(tmp_path, network, *elements)
    assert error.value.where == str(tmp_path / "s.poly.xml")
    assert error.value.problem == f"its <location> states {statements}"
    assert error.value.hint.startswith("Make the file with polyconvert and the scenario's network (-n).")


def test_rejects_points_of_other_location(tmp_path: Path) -> None:
    lamp = '<poi id="a" type="highway.street_lamp" x="2" y="2"/>'
    assert len(read_with_network(tmp_path, stated("0,0"), stated("0,0"), lamp).footprints) == 1
    with pytest.raises(InputError, match="states netOffset 30,0"):
        read_with_network(tmp_path, stated("0,0"), stated("30,0"), lamp)


def test_accepts_same_location_in_other_notation(tmp_path: Path) -> None:
    file = read_with_network(tmp_path, stated("0.00,-0.001", ""), stated("0,0"), poly("building"))
    assert file.footprints[0].polygon.bounds == (0, 0, 4, 4)
    assert not file.repaired["shapes in metres of its own <location>, brought into the world frame"]


def test_counts_shapes_that_are_converted(tmp_path: Path) -> None:
    here = Georeference(FRAME, HERE, "scenario.toml")
    moved = stated("-550690.00,-5635195.00", UTM)
    file = read_with_network(
        tmp_path, stated("-550700.00,-5635200.00", UTM), moved, poly("building", "10,5 14,5 14,9 10,9"), world=here
    )
    assert file.footprints[0].polygon.bounds == (0, 0, 4, 4)
    assert file.repaired["shapes in metres of its own <location>, brought into the world frame"] == 1


def test_rejects_two_locations(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there are two <location>s"):
        read(tmp_path, stated("0,0"), poly("building"), stated("30,0"))


# ---- a file that polyconvert made


@pytest.mark.slow
@pytest.mark.system
def test_reads_output_of_polyconvert(tmp_path: Path) -> None:
    """The corners of each building lie where the network says, at the heights of the map."""
    (tmp_path / "m.osm").write_text(
        SMALL.read_text(encoding="utf-8").replace('<nd ref="131"/><nd ref="132"/><nd ref="133"/>', '<nd ref="131"/>'),
        encoding="utf-8",
    )  # without the outline that crosses itself, which is refused
    home = sumo_home()
    types = home / "data" / "typemap" / "osmPolyconvert.typ.xml"
    environment = os.environ | {"SUMO_HOME": str(home)}
    for name, flags in (
        ("netconvert", ["-o", "n.net.xml"]),
        ("polyconvert", ["--type-file", types, "-n", "n.net.xml", "-o", "p.poly.xml", "--osm.keep-full-type",
                         "--osm.merge-relations", "1", "--all-attributes"]),
    ):  # fmt: skip
        command = [home / "bin" / name, "--osm-files", "m.osm", *flags]
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, env=environment)
    world = Georeference(network_world_frame(read_location(tmp_path / "n.net.xml")), HERE, "scenario.toml")
    assert world.frame is not None
    file = read_poly_xml(tmp_path / "p.poly.xml", SolidTypes(), 9.0, world)
    heights = {f.name: (f.base_m, f.height_m) for f in file.footprints}
    expected = {
        "2001": (0, 12), "2002": (0, 12.19), "2003": (0, 9), "2004": (0, 9), "2005": (0, 6), "2006": (3, 9),
        "2015": (4.5, 5), "3001": (0, 12), "4001": (3, 10), "4001/trunk": (0, 3),
    }  # fmt: skip
    assert {name: heights[name] for name in expected} == {name: pytest.approx(v) for name, v in expected.items()}
    areas = {f.name: f.polygon.area for f in file.footprints}
    assert areas["3001"] == pytest.approx(40 * 40 - 20 * 20, rel=1e-2)
    assert file.ignored["underground polygons of type building.garage"] == 1
    assert not any("of type" in w.problem and "solid" in w.problem for w in file.warnings)
    import sumolib

    net = sumolib.net.readNet(str(tmp_path / "n.net.xml"))
    extract = osm.read_osm(SMALL)
    corners = shapely.MultiPoint(next(f for f in file.footprints if f.name == "2001").polygon.exterior.coords)
    for node in extract.ways[2001].nodes:
        lat_deg, lon_deg = extract.nodes[node]
        assert corners.distance(shapely.Point(net.convertLonLat2XY(lon_deg, lat_deg))) < 0.01
