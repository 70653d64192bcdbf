"""OpenDRIVE maps as networks: lanes and turns by hand, what netconvert loses, and CARLA's Town01."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial import KDTree

from egvs.core.errors import InputError
from egvs.creation.map_parts import RoadMap, RoadOptions
from egvs.extensions.maps.formats.opendrive import read_opendrive
from egvs.extensions.maps.opendrive import reader as opendrive
from egvs.extensions.maps.opendrive.check import compare_with_map, read_made_network
from egvs.formats.georeference import WorldFrame
from egvs.traffic import network, sumo
from egvs.traffic.network import Network
from tests.extensions.maps import opendrive_maps as maps
from tests.extensions.maps.opendrive_maps import geometry, lane, mark, road, section

SCENARIOS = Path(__file__).parents[3] / "scenarios"
TOWN01 = Path(__file__).parents[4] / "shared" / "real" / "opendrive" / "town01.xodr.gz"

OFFSET = '<offset x="500000" y="5400000" z="120" hdg="{}"/>'
WKT = (
    'PROJCS["WGS 84 / UTM zone 32N",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",9],PARAMETER["scale_factor",0.9996],'
    'PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["metre",1],AXIS["Easting",EAST],'
    'AXIS["Northing",NORTH]]'
)


def convert(folder: Path, text: str, **options: bool) -> tuple[RoadMap, Network]:
    path = folder / "map.xodr"
    path.write_text(text)
    return read(path, folder, **options)


def read(path: Path, folder: Path, **options: bool) -> tuple[RoadMap, Network]:
    road_map = opendrive.read_roads(path, RoadOptions(**options))
    (folder / "net.net.xml").write_text(road_map.network)
    return road_map, network.read_net_xml(folder / "net.net.xml")


def turns(roads: Network) -> set[tuple[str, int, str, int]]:
    """Connections, without those that turn back."""
    edges = roads.edges
    return {
        (edges[c.source].id, c.source_lane, edges[c.target].id, c.target_lane)
        for c in roads.connections
        if c.direction != "t"
    }


def frame_of(roads: Network) -> WorldFrame | None:
    """The world frame of a network; its projection is checked."""
    assert roads.location is not None
    if roads.location.projection == "!":
        return None
    return WorldFrame.from_projection(roads.location.projection, roads.location.offset_m, "net")


def lanes(roads: Network) -> dict[str, network.Lane]:
    return {f"{edge.id}_{index}": lane for edge in roads.edges for index, lane in enumerate(edge.lanes)}


@pytest.mark.slow
@pytest.mark.system
def test_second_lane_that_leads_to_one_is_added(tmp_path: Path) -> None:
    road_map, roads = convert(tmp_path, maps.merge())
    assert turns(roads) == {("-1", 0, "-2", 0), ("-1", 1, "-2", 0)}
    assert road_map.notes[0] == "1 of 2 turns that netconvert had lost was added, from roads 1."
    assert "3 of 3 lanes for vehicles and 2 of 2 turns" in road_map.notes[1]
    assert not road_map.has_heights
    shapes = {name: lane.shape_m[:, :2].tolist() for name, lane in lanes(roads).items()}
    assert shapes == {
        "-1_0": [[0, -5.25], [100, -5.25]], "-1_1": [[0, -1.75], [100, -1.75]], "-2_0": [[120, -1.75], [220, -1.75]],
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.system
def test_text_has_no_date_and_no_path(tmp_path: Path) -> None:
    first = convert(tmp_path, maps.merge())[0].network
    (tmp_path / "other").mkdir()
    assert convert(tmp_path / "other", maps.merge())[0].network == first
    assert "generated on" not in first and str(tmp_path) not in first and "egvs-work" not in first


@pytest.mark.system
def test_connections_of_lanes_without_links_are_guesses(tmp_path: Path) -> None:
    """Lane -2 of road 1 has no link; netconvert connects a lane to the one of the same number if no lane has links."""
    two = section([lane(-1), lane(-2)])
    second = road("2", 100, geometry(100, 0, 0, 100), two, "predecessor road 1 end")
    first = road("1", 100, geometry(0, 0, 0, 100), two, "successor road 2 start")
    road_map, roads = convert(tmp_path, maps.opendrive(first, second))
    assert turns(roads) == {("-1", 0, "-2", 0), ("-1", 1, "-2", 1)}
    expected = "2 connections are guessed, from lanes that the map links to none: -1 to -2."
    assert expected in road_map.notes


@pytest.mark.slow
@pytest.mark.system
def test_patch_removes_connections(tmp_path: Path) -> None:
    roads = convert(tmp_path, maps.merge())[1]
    made = read_made_network(tmp_path / "net.net.xml")
    found = compare_with_map(made, read_opendrive(tmp_path / "map.xodr"), mirrored=False)
    wrong = replace(found, added=(("-1", 0, "-2", 0),))
    (tmp_path / "network.net.xml").write_bytes((tmp_path / "net.net.xml").read_bytes())
    name = opendrive._patch(tmp_path, made, wrong, RoadOptions())
    patched = network.read_net_xml(tmp_path / name)
    assert turns(patched) == {("-1", 1, "-2", 0)} == turns(roads) - {("-1", 0, "-2", 0)}


def test_reports_connections_that_contradict_the_map(tmp_path: Path) -> None:
    """Lane -1 leads to lane -2 in the map, but to lane -1 in the network."""
    network_text = (
        '<net><location netOffset="0,0"/>{}<connection from="-1" to="-2" fromLane="0" toLane="0" dir="s"/>'
        '<connection from="-1" to="-2" fromLane="1" toLane="1" dir="s"/></net>'
    )
    edge = '<edge id="-{0}">{1}</edge>'
    shape = '<lane index="{0}" type="driving" shape="{1},{2} {3},{2}"><param key="origId" value="{4}_{5}"/></lane>'
    edges = ""
    for number, x in ((1, 0), (2, 100)):
        pieces = [shape.format(i, x, -5.25 + 3.5 * i, x + 100, number, i - 2) for i in (0, 1)]
        edges += edge.format(number, "".join(pieces))
    (tmp_path / "n.net.xml").write_text(network_text.format(edges))
    linked = section([lane(-1, link="successor -2"), lane(-2)])
    parts = [
        road("1", 100, geometry(0, 0, 0, 100), linked, "successor road 2 start"),
        road("2", 100, geometry(100, 0, 0, 100), section([lane(-1), lane(-2)]), "predecessor road 1 end"),
    ]
    (tmp_path / "map.xodr").write_text(maps.opendrive(*parts))
    found = compare_with_map(
        read_made_network(tmp_path / "n.net.xml"), read_opendrive(tmp_path / "map.xodr"), mirrored=False
    )
    assert [(a.index, b.index) for a, b in found.missing.values()] == [(1, 0)]
    assert (found.added, found.guessed) == ((("-1", 1, "-2", 1),), (("-1", 0, "-2", 0),))
    assert found.lost_lanes == () and found.lanes == 4 and max(found.off_m.values()) < 1e-9


@pytest.mark.slow
@pytest.mark.system
def test_lane_drop_is_reported(tmp_path: Path) -> None:
    road_map, roads = convert(tmp_path, maps.lane_drop())
    notes = " ".join(road_map.notes)
    assert "8 of 8 lanes for vehicles and 5 of 5 turns" in notes
    assert "1 lane narrower than 1.8 m is closed to normal traffic" in notes  # the narrow half of the taper
    assert "Lanes of 1 road lie more than 0.3 m off the map, up to 0.8 m: 1." in notes
    assert [len(edge.lanes) for edge in roads.edges] == [3, 3, 3, 2]


@pytest.mark.system
def test_roundabout_turns_one_way(tmp_path: Path) -> None:
    road_map, roads = convert(tmp_path, maps.roundabout())
    pairs = {(source, target) for source, _, target, _ in turns(roads)}
    assert pairs == {("-4", "-3"), ("-4", "-1"), ("1", "-3"), ("-3", "-4"), ("-3", "-2"), ("2", "-4")}
    assert "6 of 6 turns" in " ".join(road_map.notes)
    ring = next(edge for edge in roads.edges if edge.id == "-3")
    x, y = ring.lanes[0].shape_m[:, :2].T
    middle = np.mean(
        [edge.lanes[0].shape_m[:, :2].mean(axis=0) for edge in roads.edges if edge.id in ("-3", "-4")], axis=0
    )
    assert np.hypot(x - middle[0], y - middle[1]) == pytest.approx(np.full(len(x), 21.75), abs=0.1)


@pytest.mark.system
def test_preserves_elevation_and_reports_superelevation(tmp_path: Path) -> None:
    road_map, roads = convert(tmp_path, maps.hill())
    assert road_map.has_heights
    assert lanes(roads)["-2_0"].shape_m.tolist() == [[100, -1.75, 6], [200, -1.75, 10]]
    assert lanes(roads)["-2_0"].length_m == pytest.approx(math.hypot(100, 4), abs=0.01)
    assert "The slope across 2 roads (superelevation) is left out: 1, 2." in road_map.notes


@pytest.mark.slow
@pytest.mark.system
def test_signals_become_lights_and_signs_are_counted(tmp_path: Path) -> None:
    light = (
        '<signal id="s1" s="95" t="-8" dynamic="yes" orientation="+" type="1000001" subtype="-1">'
        '<validity fromLane="-2" toLane="-1"/></signal>'
    )
    sign = '<signal id="s2" s="50" t="-8" dynamic="no" orientation="+" type="274" subtype="50"/>'
    road_map, roads = convert(tmp_path, maps.merge(light + sign))
    notes = " ".join(road_map.notes)
    assert "1 traffic light: places and programs are not in the network" in notes
    assert "1 sign or mark is left out." in notes and "have no effect" not in notes
    assert roads.cycle_s > 0
    # a light at the end of a road that leads nowhere
    alone = road("1", 100, geometry(0, 0, 0, 100), section([lane(-1), lane(-2)]), signals=light)
    road_map, roads = convert(tmp_path, maps.opendrive(alone))
    assert any("Traffic lights at no junction" in note and "on road 1." in note for note in road_map.notes)
    assert roads.cycle_s == 0
    road_map, roads = convert(tmp_path, maps.opendrive(alone), walk=True)
    assert "Traffic lights of these roads have no effect: 1." in road_map.notes and roads.cycle_s == 0


@pytest.mark.system
def test_one_junction_in_pieces_is_one_signal(tmp_path: Path) -> None:
    """Each arm consists of two roads, with lights of cars and of people where it meets the junction."""
    car = '<signal id="c{0}" s="0" t="5" dynamic="yes" orientation="-" type="1000001" subtype="-1"/>'
    people = (
        '<signal id="p{0}" s="0" t="5" dynamic="yes" orientation="-" type="1000002" subtype="-1">'
        '<validity fromLane="0" toLane="0"/></signal>'
    )
    elsewhere = car.replace('orientation="-"', 'orientation="+"').replace('s="0"', 's="49"').replace("c{0}", "m{0}")
    _, roads = convert(tmp_path, maps.crossing_in_pieces(car + people + elsewhere))
    assert [junction.id for junction in roads.junctions if junction.type == "traffic_light"] == ["9"]


@pytest.mark.slow
@pytest.mark.system
def test_road_over_another_is_reported(tmp_path: Path) -> None:
    """Road 2 crosses road 1 in its middle, 6 m higher."""
    one_way = section([lane(-1)])
    high = '<elevation s="0" a="6" b="0" c="0" d="0"/>'
    low = road("1", 100, geometry(0, 0, 0, 100), one_way)
    over = road("2", 100, geometry(50, -50, math.pi / 2, 100), one_way, elevation=high)
    road_map, roads = convert(tmp_path, maps.opendrive(low, over))
    assert any("In 1 place, roads lead over others: -2 over -1." in note for note in road_map.notes)
    assert not {"-1", "-2"} & {c for pair in turns(roads) for c in pair}
    flat = maps.opendrive(low, over.replace('a="6"', 'a="1"'))
    assert not any("lead over" in note for note in convert(tmp_path, flat)[0].notes)


@pytest.mark.system
@pytest.mark.parametrize("heading", [0.0, 0.5])
def test_header_offset_places_the_map(heading: float, tmp_path: Path) -> None:
    """Its heading and z, which netconvert ignores, count as well."""
    text = maps.opendrive(*maps.two_roads()).replace("</geoReference>", "</geoReference>" + OFFSET.format(heading))
    road_map, roads = convert(tmp_path, text)
    assert road_map.has_heights and "The header's offset of 120 m was added to all heights." in road_map.notes
    assert "4 of 4 lanes" in " ".join(road_map.notes)
    assert {z for lane in lanes(roads).values() for z in lane.shape_m[:, 2]} == {120.0}
    frame = frame_of(roads)
    assert frame is not None
    # (150, -1.75) of the map, turned and moved, is a point of lane -2_0, in UTM
    x = 500_000 + 150 * math.cos(heading) + 1.75 * math.sin(heading)
    y = 5_400_000 + 150 * math.sin(heading) - 1.75 * math.cos(heading)
    middle = lanes(roads)["-2_0"].shape_m[:, :2].mean(axis=0)
    assert frame.from_crs(np.array([[x, y]]), "EPSG:32632")[0] == pytest.approx(middle, abs=2e-3)


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize(("reference", "has_frame"), [
    (maps.UTM, True), (maps.UTM + " +geoidgrids=egm96_15.gtx +vunits=m", True), (WKT, True), ("EPSG:32632", True),
    ("", False), ("+lat_0=49 +lon_0=8", False), ("+proj=longlat +datum=WGS84", False), ("somewhere", False),
])  # fmt: skip
def test_reference_system_is_that_of_the_map(reference: str, has_frame: bool, tmp_path: Path) -> None:
    moved = [part.replace('x="0"', 'x="300000"').replace('x="100"', 'x="300100"') for part in maps.two_roads()]
    road_map, roads = convert(tmp_path, maps.opendrive(*moved, reference=reference))
    frame = frame_of(roads)
    assert (frame is not None) == has_frame
    start = lanes(roads)["-1_0"].shape_m[0, :2]
    if frame is None:
        assert start.tolist() == [300_000, -1.75]  # the frame of the map itself
        assert any("metres" in note for note in road_map.notes)
    else:
        assert frame.to_crs(start[None], "EPSG:32632")[0] == pytest.approx([300_000, -1.75], abs=2e-3)


@pytest.mark.system
def test_map_for_lefthand_traffic(tmp_path: Path) -> None:
    """Lane 1, 4 m wide, lies left of an axis at t = 0.5 m and leads along it; lanes -1 and -2 of 3 m lead back."""
    right = [lane(-1, width="3 0 0 0"), lane(-2, width="3 0 0 0")]
    text = maps.opendrive(
        road("1", 100, geometry(0, 0, 0, 100), section(right, [lane(1, width="4 0 0 0")]), rule="LHT").replace(
            "<lanes>", '<lanes><laneOffset s="0" a="0.5" b="0" c="0" d="0"/>'
        )
    )
    road_map, roads = convert(tmp_path, text)
    shapes = {name: (lane.width_m, lane.shape_m[:, :2].tolist()) for name, lane in lanes(roads).items()}
    assert shapes == {
        "-1_0": (4.0, [[0, 2.5], [100, 2.5]]),
        "1_0": (3.0, [[100, -4], [0, -4]]),
        "1_1": (3.0, [[100, -1], [0, -1]]),
    }
    assert 'lefthand="true"' in road_map.network and "3 of 3 lanes" in " ".join(road_map.notes)


@pytest.mark.system
def test_option_draws_lanes_on_the_left(tmp_path: Path) -> None:
    """Maps up to version 1.4 do not state a rule."""
    road_map, roads = convert(tmp_path, maps.opendrive(*maps.two_roads()), lefthand=True)
    assert lanes(roads)["-1_0"].shape_m[:, :2].tolist() == [[0, 1.75], [100, 1.75]]
    assert "4 of 4 lanes for vehicles and 2 of 2 turns" in " ".join(road_map.notes)
    with pytest.raises(InputError, match=r"is for right-hand traffic: 2 turns are from lanes on the right, 0 from"):
        convert(tmp_path, maps.merge(), lefthand=True)


@pytest.mark.system
def test_lanes_on_the_wrong_side_are_sorted(tmp_path: Path) -> None:
    """SUMO writes connecting roads for left-hand traffic with negative ids under <left>, in the order -1, -2."""
    first, through = section([lane(-1), lane(-2)]), [lane(n, link=f"predecessor {n}, successor {n}") for n in (-1, -2)]
    parts = [
        road("1", 100, geometry(0, 0, 0, 100), first, "successor junction 9"),
        road("2", 100, geometry(120, 0, 0, 100), first, "predecessor junction 9"),
        road("5", 20, geometry(100, 0, 0, 20), section(through), "predecessor road 1 end, successor road 2 start",
             junction="9").replace("right>", "left>"),
        maps.junction("9", ("1", "5", "start", "-1:-1 -2:-2")),
    ]  # fmt: skip
    road_map, roads = convert(tmp_path, maps.opendrive(*parts))
    assert turns(roads) == {("-1", 0, "-2", 0), ("-1", 1, "-2", 1)}
    assert "4 of 4 lanes for vehicles and 2 of 2 turns" in road_map.notes[0]


@pytest.mark.system
@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenario", "lefthand", "most_m"), [("nishishinjuku", True, 0.02), ("roundabout", False, 1.4)]
)
def test_network_written_as_opendrive_comes_back(scenario: str, lefthand: bool, most_m: float, tmp_path: Path) -> None:
    """All lanes with the same index, all connections, all signals; junctions of the ring cut lanes by 1.3 m more."""
    source = SCENARIOS / scenario / "network.net.xml"
    (tmp_path / "before.net.xml").write_bytes(source.read_bytes())
    flags = ["--opendrive-output.lefthand-left"] if lefthand else []
    sumo.run_program("netconvert", ["-s", "before.net.xml", "--opendrive-output", "map.xodr", *flags], tmp_path)
    before = network.read_net_xml(source)
    _, after = read(tmp_path / "map.xodr", tmp_path, lefthand=lefthand)

    def ends_m(roads: Network) -> np.ndarray:
        return np.array([[*lane.shape_m[0, :2], *lane.shape_m[-1, :2]] for lane in lanes(roads).values()])

    off_m, index = KDTree(ends_m(before)).query(ends_m(after))
    assert off_m.max() < most_m and sorted(index) == list(range(len(lanes(before))))
    names = list(lanes(before))
    match = dict(zip(lanes(after), (names[number] for number in index), strict=True))
    assert all(name.rpartition("_")[2] == other.rpartition("_")[2] for name, other in match.items())
    expected = {(f"{source}_{i}", f"{target}_{j}") for source, i, target, j in turns(before)}
    assert {(match[f"{source}_{i}"], match[f"{target}_{j}"]) for source, i, target, j in turns(after)} == expected
    lights = [sum(junction.type == "traffic_light" for junction in roads.junctions) for roads in (before, after)]
    assert lights[0] == lights[1]


def three_lanes(inner: str, middle: str, rule: str = "RHT") -> str:
    """A road of 100 m with three lanes, with the marks of the inner and of the middle one."""
    side = 1 if rule == "LHT" else -1
    parts = [lane(side * number, marks=marks) for number, marks in enumerate((inner, middle, ""), 1)]
    sides = ((), parts[::-1]) if rule == "LHT" else (parts, ())
    return maps.opendrive(road("1", 100, geometry(0, 0, 0, 100), section(*sides), rule=rule))


def changes(road_map: RoadMap) -> dict[str, set[str]]:
    """The directions in which no vehicle may change lanes, by index of the lane."""
    found = {}
    for element in ElementTree.fromstring(road_map.network).iter("lane"):
        keys = {key for key in ("changeLeft", "changeRight") if element.get(key) == "emergency"}
        if keys:
            found[element.attrib["id"].rpartition("_")[2]] = keys
    return found


@pytest.mark.system
@pytest.mark.parametrize(("marks", "expected"), [
    ((mark("broken"), mark("broken")), {}),
    ((mark("solid"), mark("broken")), {"2": {"changeRight"}, "1": {"changeLeft"}}),
    ((mark("broken"), mark("solid solid")), {"1": {"changeRight"}, "0": {"changeLeft"}}),
    ((mark("solid broken"), ""), {"2": {"changeRight"}}),  # the line of the inner lane is solid
    ((mark("broken solid"), ""), {"1": {"changeLeft"}}),
    ((mark("solid", "both"), ""), {}),  # laneChange counts
    ((mark("broken", "none"), ""), {"2": {"changeRight"}, "1": {"changeLeft"}}),
    ((mark("broken", "increase"), ""), {"2": {"changeRight"}}),  # only from lane -2 to lane -1
    ((mark("broken", "decrease"), ""), {"1": {"changeLeft"}}),
    ((mark("solid") + mark("broken", s=49), ""), {}),  # on most of its length
    ((mark("solid") + mark("broken", s=51), ""), {"2": {"changeRight"}, "1": {"changeLeft"}}),
])  # fmt: skip
def test_road_marks_forbid_lane_changes(marks: tuple[str, str], expected: dict[str, set[str]], tmp_path: Path) -> None:
    """Lane -3 is lane 0, at the kerb."""
    road_map, _ = convert(tmp_path, three_lanes(*marks))
    assert changes(road_map) == expected
    notes = [note for note in road_map.notes if note.startswith("Road marks forbid")]
    lanes = "1 lane" if len(expected) == 1 else f"{len(expected)} lanes"
    assert notes == ([f"Road marks forbid lane changes from {lanes}, of -1."] if expected else [])


@pytest.mark.system
def test_road_marks_of_lefthand_traffic(tmp_path: Path) -> None:
    """Lane 3 is lane 0, at the kerb on the left; ``increase`` leads to the left, from lane 1 to lane 2."""
    road_map, _ = convert(tmp_path, three_lanes(mark("broken", "increase"), mark("solid broken"), rule="LHT"))
    assert changes(road_map) == {"1": {"changeRight", "changeLeft"}}


@pytest.mark.system
def test_lane_that_nothing_leads_to_may_be_reached(tmp_path: Path) -> None:
    """Of road 2, only lane -1 is entered."""
    first = section([lane(-1, link="successor -1")])
    second = section([lane(-1, link="predecessor -1", marks=mark("solid")), lane(-2)])
    road_map, roads = convert(tmp_path, maps.opendrive(
        road("1", 100, geometry(0, 0, 0, 100), first, "successor road 2 start"),
        road("2", 100, geometry(100, 0, 0, 100), second, "predecessor road 1 end"),
    ))  # fmt: skip
    assert turns(roads) == {("-1", 0, "-2", 1)}
    assert changes(road_map) == {"0": {"changeLeft"}}
    assert any(note.startswith("Lanes that nothing leads to") and note.endswith("-2_0.") for note in road_map.notes)


def beside(kinds: str) -> str:
    """Two roads; lanes of 2 m of these types lie to the right of each."""
    extra = "".join(lane(-2 - number, kind, "2 0 0 0", "predecessor {0}, successor {0}".format(-2 - number))
                    for number, kind in enumerate(kinds.split()))  # fmt: skip
    return maps.opendrive(*[part.replace("</right>", f"{extra}</right>") for part in maps.two_roads()])


@pytest.mark.system
def test_only_lanes_for_vehicles_are_imported(tmp_path: Path) -> None:
    _, roads = convert(tmp_path, beside("shoulder biking sidewalk parking"))
    assert set(lanes(roads)) == {"-1_0", "-2_0", "1_0", "2_0"}
    assert lanes(roads)["-1_0"].shape_m[:, 1].tolist() == [-1.75, -1.75]


@pytest.mark.slow
@pytest.mark.system
def test_with_walk_other_lanes_are_closed_to_cars(tmp_path: Path) -> None:
    road_map, roads = convert(tmp_path, beside("shoulder biking sidewalk parking"), walk=True)
    admitted = {
        name: [kind for kind in ("passenger", "bicycle", "pedestrian") if lane.permission.admits(kind)]
        for name, lane in lanes(roads).items()
        if name.startswith("-1")
    }
    expected = {"-1_0": [], "-1_1": ["pedestrian"], "-1_2": ["bicycle"], "-1_3": []}
    assert admitted == {**expected, "-1_4": ["passenger", "bicycle"]}
    assert lanes(roads)["-1_1"].shape_m[:, 1] == pytest.approx([-8.5, -8.5])
    assert "4 of 4 lanes for vehicles and 2 of 2 turns" in " ".join(road_map.notes)


@pytest.mark.system
@pytest.mark.parametrize(("change", "message"), [
    (("</OpenDRIVE>", ""), "not well-formed"),
    (('length="100" id="1"', 'length="99999" id="1"'), "EGVS_MAX_MAP_OBJECTS"),
    (('junction="-1"', 'junction="-1" rule="LHT"'), "has roads for left-hand traffic (1) and for right-hand traffic"),
])  # fmt: skip
def test_rejects_broken_maps(
    change: tuple[str, str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EGVS_MAX_MAP_OBJECTS", "100000")
    with pytest.raises(InputError) as error:
        convert(tmp_path, maps.merge().replace(*change, 1))
    assert message in str(error.value) and "map.xodr" in str(error.value)


@pytest.mark.system
def test_speed_limits_of_roads_and_lanes(tmp_path: Path) -> None:
    """Road 1 has 25 mph, and 30 km/h from 60 m on; road 2 has none but that of its lane -1."""
    speed = '<type s="0" type="town"><speed max="50" unit="km/h"/></type>'
    first, second = maps.two_roads()
    changing = (speed + speed.replace('"0"', '"60"', 1)).replace('max="50" unit="km/h"', 'max="25" unit="mph"', 1)
    first = first.replace(speed, changing.replace("50", "30"))
    own = '<speed sOffset="0" max="10" unit="m/s"/></lane></right>'
    second = second.replace(speed, "").replace("</lane></right>", own)
    road_map, roads = convert(tmp_path, maps.opendrive(first, second))
    speeds = sorted({(edge.from_node, edge.id): round(edge.lanes[0].speed_m_s, 1) for edge in roads.edges}.values())
    assert speeds == [8.3, 8.3, 10.0, 11.2, 11.2, 13.9]
    assert "1 of 2 roads has no speed limit: 50 km/h assumed, 2." in road_map.notes


@pytest.mark.system
@pytest.mark.slow
def test_town01_keeps_all_lanes_and_turns(tmp_path: Path) -> None:
    """Road 1 is 157.54 m long, between the junctions 43 and 26; it leads to road 25 by a turn in junction 26."""
    if not TOWN01.is_file():
        pytest.skip(f"{TOWN01.name} is not beside the checkout (shared/real)")
    road_map, roads = read(TOWN01, tmp_path)
    assert "52 of 52 lanes for vehicles and 88 of 88 turns" in " ".join(road_map.notes)
    assert not any("more than 0.3 m off" in note for note in road_map.notes)
    assert not road_map.has_heights and frame_of(roads) is None
    assert lanes(roads)["-1_0"].length_m == pytest.approx(157.54, abs=0.5)
    assert ("-1", 0, "-25", 0) in turns(roads)
    walking, with_sidewalks = read(TOWN01, tmp_path, walk=True)
    assert "52 of 52 lanes for vehicles and 88 of 88 turns" in " ".join(walking.notes)
    assert sum(lane.is_pavement for lane in lanes(with_sidewalks).values()) == 52
    assert with_sidewalks.walkways.crossings > 30


@pytest.mark.system
@pytest.mark.parametrize("lefthand", [False, True])
@pytest.mark.parametrize("both_ways", [False, True])
def test_lanes_of_direct_junctions_lead_to_each_other(tmp_path: Path, lefthand: bool, both_ways: bool) -> None:
    road_map, roads = convert(tmp_path, maps.direct_junction(lefthand=lefthand, both_ways=both_ways))
    leads = {(source, target) for source, _, target, _ in turns(roads) if source.strip("-") != target.strip("-")}
    expected = {("-1", "-2"), ("-1", "-3")} | ({("2", "1")} if both_ways else set())
    assert leads == expected
    lanes_made, turns_made = (6, 3) if both_ways else (4, 2)
    assert (
        f"{lanes_made} of {lanes_made} lanes for vehicles and {turns_made} of {turns_made} turns" in road_map.notes[0]
    )
    assert not any("off the map" in note for note in road_map.notes)


@pytest.mark.system
@pytest.mark.parametrize("curvature", [0.0, 0.02, 0.069])
@pytest.mark.parametrize("change", [-1e-17, 1e-14, 1e-9, 1e-6])
def test_spirals_that_are_hardly_bent(tmp_path: Path, curvature: float, change: float) -> None:
    """netconvert divides by the change of curvature; the middle of the lane is that of the arc, to 2 cm."""
    road_map, roads = convert(tmp_path, maps.spirals(curvature, change))
    assert "2 of 2 lanes for vehicles and 1 of 1 turns" in road_map.notes[0]
    assert not any("off the map" in note for note in road_map.notes)
    assert roads.location is not None
    shape = lanes(roads)["-1_0"].shape_m[:, :2] - roads.location.offset_m
    if curvature:
        offset_m = np.hypot(shape[:, 0], shape[:, 1] - 1 / curvature) - (1 / curvature + 1.75)
    else:
        offset_m = shape[:, 1] + 1.75
    assert np.abs(offset_m).max() < 0.02


@pytest.mark.system
def test_borders_of_lanes_are_read_as_widths(tmp_path: Path) -> None:
    """The outer lane is 3 m wide, and 4 m from s = 50 m on; netconvert alone takes its own width for both."""
    inner, outer = (lane(number, width="0 0 0 0").replace("<width", "<border") for number in (-1, -2))
    outer = outer.replace("/></lane>", '/><border sOffset="50" a="-7.5" b="0" c="0" d="0"/></lane>')
    both = inner.replace('a="0"', 'a="-3.5"') + outer.replace('a="0"', 'a="-6.5"')
    road_map, roads = convert(
        tmp_path, maps.opendrive(maps.road("1", 100, maps.geometry(0, 0, 0, 100), section([both])))
    )
    assert "2 of 2 lanes for vehicles" in road_map.notes[0]
    assert lanes(roads)["-1_1"].width_m == pytest.approx(3.5)
    assert 3 <= lanes(roads)["-1_0"].width_m <= 4


@pytest.mark.system
def test_virtual_junction_is_named_and_moves_no_road(tmp_path: Path) -> None:
    """Road 31 leaves road 1 at s = 20 m; netconvert alone would let road 1 end there."""
    one = section([lane(-1, link="predecessor -1, successor -1")])
    branch = maps.road("31", 20, maps.geometry(20, 0, -0.5, 20), one, "predecessor road 1, successor road 32 start",
                       junction="9")  # fmt: skip
    drive = maps.road(
        "32", 50, maps.geometry(38, -9, -1, 50), section([lane(-1)], [lane(1)]), "predecessor road 31 end"
    )
    virtual = maps.junction("9", ("1", "31", "start", "-1:-1")).replace("name", 'type="virtual" mainRoad="1" name')
    road_map, roads = convert(tmp_path, maps.opendrive(*maps.two_roads(), branch, drive, virtual))
    assert "1 virtual junction, which joins roads between their ends, and the roads through it are left out: 31." in (
        road_map.notes
    )
    assert lanes(roads)["-1_0"].length_m == pytest.approx(100, abs=0.1)
    assert {(source, target) for source, _, target, _ in turns(roads)} == {("-1", "-2"), ("2", "1")}


@pytest.mark.system
def test_turn_through_two_junctions_without_a_road_between_is_named(tmp_path: Path) -> None:
    """Road 1 leads to road 2 by road 11 in junction 8 and road 21 in junction 9; netconvert sees no road between."""
    one = section([lane(-1, link="predecessor -1, successor -1")])
    road_map, _ = convert(tmp_path, maps.opendrive(
        road("1", 100, geometry(0, 0, 0, 100), section([lane(-1)]), "successor junction 8"),
        road("11", 20, geometry(100, 0, 0, 20), one, "predecessor road 1 end, successor junction 9", junction="8"),
        road("21", 20, geometry(120, 0, 0, 20), one, "predecessor junction 8, successor road 2 start", junction="9"),
        road("2", 100, geometry(140, 0, 0, 100), section([lane(-1)]), "predecessor junction 9"),
        maps.junction("8", ("1", "11", "start", "-1:-1")), maps.junction("9", ("11", "21", "start", "-1:-1")),
    ))  # fmt: skip
    notes = " ".join(road_map.notes)
    assert "of 1 turns of the map" in notes
    assert ("0 of 1 turns" in notes) == ("Turns between these roads are missing: 1 to 2." in notes)


@pytest.mark.system
def test_limit_of_netconvert_says_nothing_against_the_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise sumo.program_error("netconvert", 1, "Error: std::bad_alloc", sumo.Allowance(300, 1))

    monkeypatch.setattr(sumo, "run_netconvert", fail)
    with pytest.raises(InputError) as error:
        convert(tmp_path, maps.merge())
    assert str(error.value).endswith(
        "map.xodr: netconvert cannot use the map: netconvert needed more than 300 MB of memory. The limit is 2,000 MB;"
        " set EGVS_MAX_SUMO_MB to raise it."
    )


@pytest.mark.system
def test_network_that_cannot_be_read_names_the_map(tmp_path: Path) -> None:
    steep = '<elevation s="0" a="0" b="0" c="2147483648" d="0"/>'
    with pytest.raises(InputError) as error:
        convert(tmp_path, maps.opendrive(road("7", 100, geometry(0, 0, 0, 100), section([lane(-1)]), elevation=steep)))
    assert str(error.value).startswith(f"{tmp_path / 'map.xodr'}: the network cannot be used: lane ")


@pytest.mark.system
def test_light_where_two_roads_join_is_none(tmp_path: Path) -> None:
    """It governs no conflicting movements; netconvert would stop cars at the joint, and at the end of the road."""
    light = '<signal id="s1" s="98" t="5" dynamic="yes" orientation="+" type="1000001" subtype="-1"/>'
    road_map, roads = convert(tmp_path, maps.opendrive(*maps.two_roads(signals=light)))
    assert not any(junction.type == "traffic_light" for junction in roads.junctions)
    assert roads.cycle_s == 0
    assert any(
        "Traffic lights at no junction, such as those of pedestrian crossings, are left out (--walk keeps them),"
        " on roads 1, 2." in note
        for note in road_map.notes
    )
