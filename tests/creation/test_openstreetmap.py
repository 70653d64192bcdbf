"""Scenarios from OpenStreetMap extracts, small and real, and rejected extracts."""

from __future__ import annotations

import csv
import gzip
import itertools
import json
import math
import re
from collections import Counter
from pathlib import Path
from typing import Any, get_type_hints

import pytest
import shapely
from shapely.geometry import LineString, Point, shape

from egvs.cli import app, new_summary
from egvs.core.errors import InputError
from egvs.creation import assumed_traffic, new_scenario
from egvs.creation.assumed_traffic import AssumedTraffic
from egvs.creation.map_parts import ImportCounts
from egvs.creation.openstreetmap import reader as openstreetmap
from egvs.formats import osm
from egvs.scenario import loading
from egvs.sensors import sites
from egvs.stages import check
from egvs.traffic.capacity import Capacity, TrialRun
from tests.creation.new_scenarios import create_scenario
from tests.formats.test_osm import pbf_of
from tests.stage_runner import run_stage

SMALL = Path(__file__).parent / "data" / "small.osm"


REAL = Path(__file__).parents[3] / "shared" / "real" / "bad_hersfeld.osm"


Made = tuple[Path, new_scenario.NewScenario]


NAMES = [
    "counts.csv",
    "network.net.xml",
    "scenario.toml",
    "signals.csv",
    "sites.csv",
    "statics.geojson",
    "zones.geojson",
]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """The small extract's scenario and its summary."""
    folder = tmp_path_factory.mktemp("osm") / "cross"
    return folder, create_scenario(folder, SMALL)


@pytest.fixture(scope="module")
def footprints(made: Made) -> dict[str, Any]:
    """Features by name."""
    features = json.loads((made[0] / "statics.geojson").read_text(encoding="utf-8"))["features"]
    by_name = {f["properties"]["name"]: f for f in features}
    assert len(by_name) == len(features), "a name stands there twice"
    return by_name


def area_of(feature: Any) -> shapely.Geometry:
    """What a feature covers, seen from above."""
    geometry = shape(feature["geometry"])
    radius_m = feature["properties"].get("radius_m")
    return geometry.buffer(radius_m, quad_segs=64) if radius_m else geometry


def lanes_of(folder: Path) -> list[tuple[LineString, float]]:
    """All lanes as sumolib reads them: the middle line, half the width."""
    import sumolib

    net = sumolib.net.readNet(str(folder / "network.net.xml"), withInternal=True)
    lanes = [lane for edge in net.getEdges(withInternal=True) for lane in edge.getLanes()]
    return [(LineString([p[:2] for p in lane.getShape()]), lane.getWidth() / 2) for lane in lanes]


def sites_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "sites.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def edited(tmp_path: Path, *changes: tuple[str, str]) -> Path:
    """A copy of the small extract with patterns replaced; each must be there."""
    text = SMALL.read_text(encoding="utf-8")
    for pattern, replacement in changes:
        text, count = re.subn(pattern, replacement, text, flags=re.DOTALL)
        assert count, pattern
    path = tmp_path / "edited.osm"
    path.write_text(text, encoding="utf-8")
    return path


# --- what is in the scenario ---------------------------------------------------------------------------------------
@pytest.mark.slow
def test_heights_by_source(made: Made) -> None:
    heights = made[1].statics.counts.heights
    assert heights["building"] == {"height": 5, "levels": 3, "neighbours": 3}
    assert heights["roof"] == {"type": 1}
    assert heights["tree"] == {"height": 1, "default": 7}
    assert heights["barrier"] == {"height": 1, "default": 3}
    assert heights["pole"] == {"default": 3}


@pytest.mark.slow
def test_counts_changed_and_dropped_objects(made: Made) -> None:
    counted = made[1].statics.counts
    assert counted.unreadable == {"height": 1}
    assert counted.repaired == 1
    assert counted.cut == {"building": 1, "barrier": 1}
    assert counted.dropped == {
        "degenerate": {"building": 1},
        "incomplete": {"building": 1},
        "on_carriageway": {"building": 1, "pole": 2, "tree": 1},
        "row_tree_mapped_singly": {"tree": 1},
        "underground": {"building": 1},
    }
    assert counted.raised_crowns == 1
    assert counted.not_modelled == {"barrier=ditch": 1, "power=tower": 1}
    assert json.loads((made[0] / "statics.geojson").read_text(encoding="utf-8"))["summary"] == counted.to_json()


def test_assumed_sizes_are_listed_with_their_numbers(made: Made) -> None:
    assumed = loading.load(made[0]).assumed
    assert {"heights of 3 of 11 buildings", "heights of 7 of 8 trees"} < set(assumed)
    assert "crown widths of 7 of 8 trees" in assumed
    assert not any("bridge" in entry for entry in assumed)


def test_sizes_from_the_map_are_not_assumed() -> None:
    counts = ImportCounts(heights={"tree": Counter(height=4), "bridge": Counter(height=1, default=2)})
    assert new_scenario.assumed_sizes(counts) == ["heights of 2 of 3 bridge decks"]


def test_every_object_is_used_or_counted(footprints: dict[str, Any], made: Made) -> None:
    complete = Counter(f["properties"]["kind"] for name, f in footprints.items() if not name.endswith("#2"))
    assert complete == made[1].statics.counts.objects


@pytest.mark.parametrize(
    ("name", "top_m", "base_m", "source"),
    [
        ("way/2001", 12.0, 0.0, "height"),
        ("way/2002", 12.192, 0.0, "height"),
        ("way/2003", 9.0, 0.0, "levels"),
        ("way/2004", 9.0, 0.0, "neighbours"),
        ("way/2005", 6.0, 0.0, "levels"),
        ("way/2006", 9.0, 3.0, "height"),
        ("way/2014", 20.0, 0.0, "height"),
        ("way/2015", 5.0, 4.5, "type"),
        ("relation/3001", 12.0, 0.0, "levels"),
        ("node/4001/trunk", 3.0, 0.0, "height"),
        ("node/4001/crown", 10.0, 3.0, "height"),
        ("node/4004/crown", 8.0, 4.5, "default"),
        ("way/5001", 1.8, 0.0, "height"),
    ],
)
def test_top_and_base(footprints: dict[str, Any], name: str, top_m: float, base_m: float, source: str) -> None:
    properties = footprints[name]["properties"]
    assert (properties["height_m"], properties.get("base_m", 0.0), properties["height_from"]) == (top_m, base_m, source)


@pytest.mark.parametrize(
    ("name", "area_m2"),
    [
        ("way/2001", 400.0),
        ("relation/3001", 40 * 40 - 20 * 20),
        ("way/2007#1", 25.0),
        ("way/2007#2", 25.0),
        ("way/2013", 20 * 10),
        ("way/2014", 10 * 10),
        ("way/5003", 10 * 2),
    ],
)
def test_area(footprints: dict[str, Any], name: str, area_m2: float) -> None:
    # The projection's scale, round metres a degree and seven decimals of a degree (1 cm) together make up to one
    # percent.
    assert shape(footprints[name]["geometry"]).area == pytest.approx(area_m2, rel=1e-2)


def test_courtyard_stays_open(footprints: dict[str, Any]) -> None:
    rings = footprints["relation/3001"]["geometry"]["coordinates"]
    assert [len(ring) for ring in rings] == [5, 5]


def test_trees_of_a_row_are_8_m_apart(footprints: dict[str, Any]) -> None:
    points = [shape(f["geometry"]) for name, f in footprints.items() if re.fullmatch(r"way/4010/\d/trunk", name)]
    gaps = [a.distance(b) for a, b in itertools.pairwise(points)]
    assert gaps == pytest.approx([16.0, 8.0, 8.0, 8.0], abs=0.01), "the second was mapped singly"


def test_no_solid_is_on_carriageway(made: Made, footprints: dict[str, Any]) -> None:
    low = shapely.union_all([area_of(f) for f in footprints.values() if f["properties"].get("base_m", 0) < 4.5])
    for line, half_width_m in lanes_of(made[0]):
        assert not low.intersects(line.buffer(half_width_m, cap_style="flat"))
    assert {"way/2010#1", "way/2010#2", "way/5002#1", "way/5002#2"} <= footprints.keys()


def test_buildings_are_in_network_frame(made: Made, footprints: dict[str, Any]) -> None:
    import sumolib

    net = sumolib.net.readNet(str(made[0] / "network.net.xml"))
    extract = osm.read_osm(SMALL)
    for way in (2001, 2002, 2003, 2004):
        corners = shapely.MultiPoint(footprints[f"way/{way}"]["geometry"]["coordinates"][0])
        for node in extract.ways[way].nodes:
            lat_deg, lon_deg = extract.nodes[node]
            assert corners.distance(Point(net.convertLonLat2XY(lon_deg, lat_deg))) < 0.002
    lat_deg, lon_deg = extract.nodes[1]
    assert net.convertLonLat2XY(lon_deg, lat_deg) == pytest.approx(net.getNode("1").getCoord(), abs=0.01)


def check_sites(folder: Path, poles: int) -> None:
    """Sites stand beside the carriageway, clear of everything, in or near the region."""
    rows = sites_of(folder)
    places = [(float(row["x_m"]), float(row["y_m"])) for row in rows]
    assert [row["site"] for row in rows] == [f"k{i:02d}" for i in range(1, len(rows) + 1)]
    assert len(rows) == poles and len(set(places)) == poles
    lanes = lanes_of(folder)
    features = json.loads((folder / "statics.geojson").read_text(encoding="utf-8"))["features"]
    solids = [area_of(f) for f in features]
    low, size = (loading.load(folder).roi.box.origin_m, loading.load(folder).roi.box.size_m)
    box = shapely.box(low[0], low[1], low[0] + size[0], low[1] + size[1])
    for where in map(Point, set(places)):
        assert min(line.distance(where) - half_width_m for line, half_width_m in lanes) >= 0.5
        assert min((solid.distance(where) for solid in solids), default=math.inf) >= 1.0
        assert box.distance(where) <= 5.0 * 2**0.5
    assert min(Point(a).distance(Point(b)) for a in places for b in places if a != b) >= 5.0


def test_sites_are_next_to_kerb(made: Made) -> None:
    check_sites(made[0], 12)


def test_each_pole_has_three_heights_and_tilts_aimed_at_region(made: Made) -> None:
    scenario = loading.load(made[0])
    result = sites.candidate_sites(scenario)
    assert len(result) == made[1].n_candidates == 9 * made[1].poles == 9 * 12
    assert [site.name for site in result[:4]] == ["k01@3m+0deg", "k01@3m-5deg", "k01@3m-10deg", "k01@4.5m+0deg"]
    x_m, y_m, _ = scenario.roi.center_m
    for site in result:
        east_m, north_m = x_m - site.pose.x_m, y_m - site.pose.y_m
        off_deg = math.degrees(math.atan2(north_m, east_m)) - site.pose.yaw_deg
        assert (off_deg + 180) % 360 - 180 == pytest.approx(0, abs=1e-5)
        assert site.pose.pitch_deg in (0, -5, -10)
        assert site.sensor == "VLP-32C"


def test_scenario_loads(made: Made) -> None:
    folder, summary = made
    loaded = loading.load(folder)
    assert loaded.name == "cross"
    assert loaded.roi.size_m == (60.0, 60.0, 5.0)
    assert [value % 0.25 for value in loaded.roi.box.origin_m] == [0.0, 0.0, 0.0]
    assert loaded.traffic.vehicles is None
    assert loaded.traffic.counts == summary.flows and len(summary.flows) == 12
    assert summary.junction.at_m == pytest.approx(loaded.roi.center_m[:2], abs=1.0)
    for name in ("network.net.xml", "statics.geojson", "sites.csv"):
        assert loaded.find(name, "test").is_file()


def test_each_count_has_its_movement_in_words(made: Made) -> None:
    header, *rows = (made[0] / "counts.csv").read_text(encoding="utf-8").splitlines()
    assert header == "approach,turn,to,edge,from_edge,to_edge,count"
    words = [row.split(",")[:3] for row in rows]
    assert len(words) == 12
    assert ["North Street (south)", "straight", "North Street"] in words
    assert ["North Street (south)", "left", "East Street"] in words
    assert ["East Street (west)", "right", "North Street"] in words


@pytest.mark.slow
def test_printed_solids_are_those_of_the_check(made: Made, capsys: pytest.CaptureFixture[str]) -> None:
    new_summary.print_new_scenario(made[1])
    printed = re.search(r"^solids +(\d+) objects \((\d+) solids", capsys.readouterr().out, re.MULTILINE)
    assert printed is not None
    n_objects, n_solids = int(printed[1]), int(printed[2])
    assert n_solids == check.check_scenario(loading.load(made[0])).solids > n_objects


def test_prints_the_tables_to_edit_and_the_next_commands(made: Made, capsys: pytest.CaptureFixture[str]) -> None:
    new_summary.print_new_scenario(made[1])
    edit, run, place = capsys.readouterr().out.splitlines()[-3:]
    tables = re.findall(r"(\w+\.csv) \(", edit)
    assert tables == ["counts.csv", "signals.csv", "sites.csv"]
    assert all((made[0] / name).is_file() for name in tables)
    assert run == f"next: egvs run {made[0]}"
    assert place.strip().startswith(f"egvs place {made[0]} --count 2")


def test_names_junction_and_attributes_source(made: Made) -> None:
    folder, summary = made
    assert summary.junction.title == "signalised junction of East Street and North Street"
    for name in ("scenario.toml", "statics.geojson", "network.net.xml"):
        assert "(c) OpenStreetMap contributors, ODbL" in (folder / name).read_text(encoding="utf-8")


@pytest.mark.slow
def test_special_characters_in_street_name_and_comments(tmp_path: Path) -> None:
    named = edited(tmp_path, ('v="East Street"', 'v="East A\\\\B = #1 &quot;Straße&quot; &amp; more"'))
    title = create_scenario(tmp_path / "named", named).junction.title
    assert title == 'signalised junction of East A\\B = #1 "Straße" & more and North Street'
    assert loading.load(tmp_path / "named").description == f"S{title[1:]}"
    text = (tmp_path / "named" / "scenario.toml").read_text(encoding="utf-8")
    assert re.search(r"^counts = .* # assumed from the road classes", text, re.MULTILINE)
    assert len(re.findall(r"^\[(?:roi|traffic|statics|sites)\] +# \w", text, re.MULTILINE)) == 4


# --- the same input, the same bytes --------------------------------------------------------------------------------
@pytest.mark.slow
def test_same_bytes_from_other_folder_pbf_and_other_order(made: Made, tmp_path: Path) -> None:
    text = SMALL.read_text(encoding="utf-8")
    nodes = re.findall(r" <node .*?(?:</node>|/>)\n", text)
    first, last = text.index(nodes[0]), text.index(nodes[-1]) + len(nodes[-1])
    packed = tmp_path / "packed.osm.gz"
    packed.write_bytes(gzip.compress((text[:first] + "".join(reversed(nodes)) + text[last:]).encode()))
    for number, source in enumerate((packed, pbf_of(SMALL, tmp_path / "small.osm.pbf"))):
        again = tmp_path / "elsewhere" / str(number)
        create_scenario(again, source)
        assert sorted(p.name for p in again.iterdir()) == NAMES
        for name in NAMES:
            content = (again / name).read_bytes().replace(f'name = "{number}"\n'.encode(), b"")
            assert content == (made[0] / name).read_bytes(), name
            assert b"generated on" not in content and str(tmp_path).encode() not in content


# --- variants ------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_left_hand_traffic(tmp_path: Path) -> None:
    create_scenario(tmp_path / "left", SMALL, lefthand=True)
    assert 'lefthand="true"' in (tmp_path / "left" / "network.net.xml").read_text(encoding="utf-8")


@pytest.mark.slow
def test_sidewalks_and_crossings_change_neither_junction_nor_lanes(made: Made, tmp_path: Path) -> None:
    walked = create_scenario(tmp_path / "walked", SMALL, walk=True)
    plain = made[1]
    assert walked.notes[:-1] == plain.notes and "pedestrians_per_h" in walked.notes[-1]
    assert (walked.junction.title, walked.junction.lanes_in) == (plain.junction.title, plain.junction.lanes_in)
    assert walked.streets.lane_length_m == pytest.approx(plain.streets.lane_length_m, rel=0.05)  # larger corners
    assert plain.streets.network.walkways.sidewalks == ()
    ways = walked.streets.network.walkways
    assert len({walk.part for walk in ways.sidewalks}) == 1 and len(ways.sidewalks) > 3
    assert ways.crossings > 3 and ways.areas > 3


@pytest.mark.slow
def test_fills_empty_folder_and_repairs_name_with_spaces(tmp_path: Path) -> None:
    folder = tmp_path / "my junction"
    folder.mkdir()
    create_scenario(folder, SMALL, at=(52.0, 10.0))
    assert loading.load(folder).name == "my-junction"
    assert [p.name for p in tmp_path.iterdir()] == ["my junction"]


@pytest.mark.slow
def test_without_signals_chooses_largest_junction_with_note(tmp_path: Path) -> None:
    plain = edited(tmp_path, (' <node id="1" ([^>]*)>.*?</node>', r' <node id="1" \1/>'))
    summary = create_scenario(tmp_path / "plain", plain)
    assert summary.junction.title == "junction without signals of East Street and North Street"
    assert any("in the map has signals" in note for note in summary.notes)


@pytest.mark.slow
def test_counts_open_ring(tmp_path: Path) -> None:
    deleted = ('<node id="1" ', '<node id="77" action="delete"/><node id="1" ')
    torn = edited(tmp_path, (' <way id="2102">.*?</way>', ""), deleted)
    summary = create_scenario(tmp_path / "torn", torn)
    assert summary.statics.counts.dropped["incomplete"] == {"building": 2}
    assert summary.statics.counts.heights["building"]["levels"] == 2


@pytest.mark.slow
def test_row_of_trees_around_the_world_is_left_out(tmp_path: Path) -> None:
    far = edited(tmp_path, ('<node id="173" lat="51.9998203" lon="[^"]*"/>', '<node id="173" lat="52" lon="174"/>'))
    counts = create_scenario(tmp_path / "far", far).statics.counts
    assert counts.dropped["too_long"] == {"tree row": 1}
    assert counts.heights["tree"].total() == 3, "those mapped singly"


# --- a real town ---------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """The scenario of a real extract."""
    if not REAL.is_file():
        pytest.skip(f"{REAL.name} is not beside the checkout (shared/real)")
    folder = tmp_path_factory.mktemp("osm") / "town"
    return folder, create_scenario(folder, REAL, surroundings_m=math.inf)


@pytest.mark.slow
def test_real_town(town: Made) -> None:
    folder, summary = town
    assert "Seilerweg" in summary.junction.title and summary.junction.signalised
    assert len(summary.junction.nodes) == 3  # they have one signal
    assert isinstance(summary.traffic, AssumedTraffic) and summary.traffic.assumed_per_h > 1000
    assert summary.statics.counts.heights["building"] == {"levels": 4, "default": 162}
    assert summary.statics.counts.objects["tree_trunk"] == 0
    assert summary.statics.counts.dropped["out_of_range"] == {"barrier": 5, "building": 476, "pole": 15, "tree": 15}
    assert loading.load(folder).roi.grid.shape == (280, 440, 20)
    check_sites(folder, 12)


@pytest.mark.slow
def test_real_town_is_in_network_frame(town: Made) -> None:
    import sumolib

    net = sumolib.net.readNet(str(town[0] / "network.net.xml"))
    extract = osm.read_osm(REAL)
    ends = [node for node in net.getNodes() if node.getType() == "dead_end" and int(node.getID()) in extract.nodes]
    assert len(ends) >= 10
    for node in ends:
        lat_deg, lon_deg = extract.nodes[int(node.getID())]
        assert net.convertLonLat2XY(lon_deg, lat_deg) == pytest.approx(node.getCoord(), abs=0.01)


@pytest.mark.slow
def test_real_town_at_position(town: Made, tmp_path: Path) -> None:
    summary = create_scenario(tmp_path / "other", REAL, at=(50.8704, 9.7080), surroundings_m=math.inf)
    assert summary.junction.title == "signalised junction of Benno-Schilde-Straße and Dippelstraße"
    check_sites(tmp_path / "other", 12)
    assert (tmp_path / "other" / "network.net.xml").read_bytes() == (town[0] / "network.net.xml").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("walk", [False, True])
def test_people_move_in_real_town(town: Made, tmp_path: Path, walk: bool) -> None:
    from egvs.stages import traffic

    del town  # the file is there
    create_scenario(tmp_path / "town", REAL, walk=walk)
    rates = {"bicycles_per_h": 100, "pedestrians_per_h": 200} if walk else {"bicycles_per_h": 100}
    people = [f"effects.pedestrians_bicycles.{key}={rate}" for key, rate in rates.items()]
    scenario = loading.load(tmp_path / "town", [*people, "traffic.frames=50", "traffic.warmup_s=60", "tpog.blocks=5",
                                                "traffic.hold='at_most'"])  # fmt: skip
    summary = run_stage(traffic, scenario, tmp_path / "run")
    assert summary["beside_vehicles"]["bicycle"]["most"] > 0
    assert ("pedestrian" in summary["beside_vehicles"]) == walk


@pytest.mark.slow
def test_traffic_of_real_junction_flows(town: Made, tmp_path: Path) -> None:
    from egvs.stages import traffic

    del town  # the file is there
    create_scenario(tmp_path / "town", REAL, at=(50.8704, 9.7080))
    summary = run_stage(traffic, loading.load(tmp_path / "town", ["traffic.frames=400"]), tmp_path)
    assert all(count["geh"] < 5 for count in summary["counts"]) and summary["longest_standing_s"] < 120
    assert not {"counts", "standing", "waiting"} & {warning["rule"] for warning in summary["warnings"]}


COVER = (
    '<node id="1" ',
    '<node id="901" lat="51.99" lon="9.99"/><node id="902" lat="51.99" lon="10.01"/>'
    '<node id="903" lat="52.01" lon="10.01"/><node id="904" lat="52.01" lon="9.99"/><node id="1" ',
)


BLOCK = (
    "<relation",
    '<way id="9"><nd ref="901"/><nd ref="902"/><nd ref="903"/><nd ref="904"/><nd ref="901"/>'
    '<tag k="building" v="yes"/></way><relation',
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([("</osm>", "")], "is not well-formed XML"),
        ([("^.*", "")], "is not well-formed XML"),
        ([("^.*", '{"elements": []}')], "is not well-formed XML"),
        ([("^.*", '<gpx version="1.1"></gpx>')], "expected the root element <osm>, got <gpx>"),
        ([("^.*", '<osm version="0.6"></osm>')], "has no nodes"),
        ([("<osm ", '<!DOCTYPE osm [<!ENTITY a "b">]><osm ')], "entities"),
        ([('"52.0000000"', '"52 N"')], "node 1: lat: expected degrees from -90 to 90, got '52 N'"),
        ([('"52.0000000"', '"nan"')], "node 1: lat: expected degrees from -90 to 90, got 'nan'"),
        ([('lon="10.0000000"', "")], "node 1: lon: expected degrees from -180 to 180, got None"),
        ([('maxlat="', 'maxlat="9')], "bounds: maxlat"),
        ([('<way id="1001">', "<way>")], "<way> id: expected a whole number, got None"),
        ([('<nd ref="1"/>', '<nd ref="one"/>')], "way 1001: ref: expected a whole number, got 'one'"),
        ([('"(secondary|tertiary)"', '"footway"')], "has no drivable streets that meet"),
        ([('"highway"', '"was:highway"')], "has no drivable streets that meet"),
        ([(' <way id="1002">.*?</way>', "")], "has no drivable streets that meet"),
        ([COVER, BLOCK], "along the kerbs of the signalised junction of East Street"),
    ],
)
def test_rejects_bad_extract(tmp_path: Path, changes: list[tuple[str, str]], message: str) -> None:
    if changes[0][0] == "^.*":
        bad = tmp_path / "edited.osm"
        bad.write_text(changes[0][1], encoding="utf-8")
    else:
        bad = edited(tmp_path, *changes)
    with pytest.raises(InputError) as caught:
        create_scenario(tmp_path / "out", bad)
    assert message in str(caught.value) and str(bad) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == [bad], "something was written"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (gzip.compress(b"<osm></osm>", mtime=0)[:-6], "damaged gzip"),
        (b"\x00\x00\x00\x0d\x0a\x09OSMHeader\x18\x7d", r"cannot be read as OpenStreetMap data \(PBF error"),
        (b"\x89PNG\r\n\x1a\n" + bytes(64), "is not well-formed XML"),
    ],
)
def test_rejects_bad_file(tmp_path: Path, content: bytes, message: str) -> None:
    bad = tmp_path / "bad.osm"
    bad.write_bytes(content)
    with pytest.raises(InputError, match=re.escape(str(bad)) + ".*" + message):
        create_scenario(tmp_path / "out", bad)
    assert list(tmp_path.iterdir()) == [bad]


def test_rejects_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.osm: no such file"):
        create_scenario(tmp_path / "out", tmp_path / "nowhere.osm")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("at", [(0.0, 0.0), (52.0, 52.0), (float("nan"), 10.0)])
def test_rejects_position_outside_extract(tmp_path: Path, at: tuple[float, float]) -> None:
    with pytest.raises(InputError, match=r"--at: .* is outside the extract.*latitude 51\.998"):
        create_scenario(tmp_path / "out", SMALL, at=at)
    assert not list(tmp_path.iterdir())


def test_suggests_position_with_latitude_first(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape("Latitude comes first: did you mean --at 52.0,10.0?")):
        create_scenario(tmp_path / "new", SMALL, (10.0, 52.0))
    assert not (tmp_path / "new").exists()


def test_rejects_folder_with_content(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep me", encoding="utf-8")
    with pytest.raises(InputError, match="not empty"):
        create_scenario(tmp_path, SMALL)
    with pytest.raises(InputError, match=r"mine\.txt: .*existing file"):
        create_scenario(tmp_path / "mine.txt", SMALL)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.slow
@pytest.mark.parametrize(("level", "share"), [("light", 0.4), ("medium", 0.75), ("heavy", 1.0)])
def test_traffic_is_a_share_of_what_the_junction_carries(tmp_path: Path, level: str, share: float) -> None:
    summary = create_scenario(tmp_path / "out", SMALL, traffic=level)
    traffic = summary.traffic
    assert isinstance(traffic, AssumedTraffic) and traffic.capacity.is_everything
    assert traffic.carried_per_h == traffic.assumed_per_h > 500
    assert [flow.per_hour for flow in summary.flows] == [round(flow.per_hour * share) for flow in traffic.assumed]
    assert traffic.summary == (
        f"carries at least {traffic.assumed_per_h:,} vehicles an hour; {level} {100 * share:.0f} % is used"
    )
    text = (tmp_path / "out" / "scenario.toml").read_text(encoding="utf-8")
    assert 'counts = "counts.csv" # assumed from the road classes: replace its numbers by real counts' in text
    loaded = loading.load(tmp_path / "out")
    assert (loaded.traffic.junction_blocker_s, loaded.traffic.teleport_s) == (10.0, 120.0)


@pytest.mark.slow
def test_flow_above_capacity_is_reduced_and_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    jam = TrialRun(1.0, 100, 50, 300.0, 20, "junction 1, Main Street from 20 s on")
    runs = (jam, TrialRun(0.7, 70, 70, 50.0, 0))
    monkeypatch.setattr(assumed_traffic, "find_capacity", lambda *_: Capacity(0.644, runs))
    traffic = create_scenario(tmp_path / "out", SMALL).traffic
    assert isinstance(traffic, AssumedTraffic)
    assert traffic.carried_per_h == 10 * round(0.0644 * traffic.assumed_per_h)
    carried = f"{traffic.carried_per_h:,} of {traffic.assumed_per_h:,}"
    assert traffic.summary == f"carries {carried} vehicles an hour; medium 75 % is used"
    assert traffic.per_h == pytest.approx(0.75 * traffic.carried_per_h, abs=12)
    monkeypatch.setattr(assumed_traffic, "find_capacity", lambda *_: Capacity(0.155, runs[:1]))
    notes = create_scenario(tmp_path / "jammed", SMALL).notes
    assert notes[-1] == (
        "Traffic jams occur in the trial; a vehicle stood for 300 s at junction 1, Main Street from 20 s on."
        " Lower per_hour of traffic.counts, or check the signals and connections there."
    )


def test_rejects_unknown_level_of_traffic(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--traffic: expected light, medium or heavy, got 'rush'"):
        create_scenario(tmp_path / "out", SMALL, traffic="rush")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_smaller_surroundings_keep_sites_and_flows(tmp_path: Path) -> None:
    made = {r: create_scenario(tmp_path / str(r), SMALL, surroundings_m=r) for r in (120.0, 150.0, math.inf)}
    lengths = [summary.streets.lane_length_m for summary in made.values()]
    assert lengths == sorted(lengths) and lengths[0] < 0.8 * lengths[-1]
    for name in ("sites.csv", "statics.geojson"):
        assert len({(tmp_path / str(r) / name).read_bytes() for r in made}) == 1
    flows = [sorted(flow.per_hour for flow in summary.flows) for summary in made.values()]
    assert flows[0] == flows[1] == flows[2] and len(flows[0]) == 12 and sum(flows[0]) > 500
    assert len({summary.region.roi for summary in made.values()}) == 1
    assert loading.load(tmp_path / "inf").traffic.counts == made[math.inf].flows


def test_help_names_default_surroundings() -> None:
    (option,) = get_type_hints(app.new, include_extras=True)["surroundings"].__metadata__
    assert f"; {openstreetmap.SURROUNDINGS_M:g} by default" in option.help


def test_rejects_surroundings_smaller_than_junction(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--surroundings: expected at least 100 m, got 60 m"):
        create_scenario(tmp_path / "small", SMALL, surroundings_m=60.0)
    assert not (tmp_path / "small").exists()


@pytest.mark.slow
@pytest.mark.parametrize("lefthand", [False, True])
def test_junction_is_where_the_map_puts_it(tmp_path: Path, lefthand: bool) -> None:
    """netconvert writes a wrong offset of y for left-hand traffic in a given frame."""
    made = create_scenario(tmp_path / "out", SMALL, (52.0, 10.0), lefthand=lefthand)
    ((lon_deg, lat_deg),) = made.streets.to_degrees([made.junction.at_m])
    assert (lat_deg, lon_deg) == pytest.approx((52.0, 10.0), abs=1e-4)
