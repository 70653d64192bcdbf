"""Creating a city from a map: its junctions, their scenarios, and messages about wrong input.

The map has a street from west to east with three junctions 200 m apart: A and B with signals, C without, where a large
building covers all kerbs. The scenarios are compared with those of ``egvs new``."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path

import pytest
import shapely
from shapely.geometry import box, shape

import egvs
from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.creation import junctions
from egvs.creation.junctions import StreetJunction
from egvs.creation.openstreetmap import street_network
from egvs.extensions.city import creation, model, network_excerpts, traffic_split
from egvs.extensions.city.creation import NewCityOptions
from egvs.extensions.city.town_flow import FlowCapacity, FlowTrial
from egvs.formats import osm
from egvs.stages import traffic
from egvs.traffic import network
from egvs.world import geolocation
from tests.creation.new_scenarios import create_scenario
from tests.creation.test_driving_side import ring_map
from tests.creation.test_turn_restrictions import APART_M, divided_road
from tests.stage_runner import run_stage

pytestmark = pytest.mark.system
LAT, LON = 50.0, 10.0
CROSSINGS = {"A": -200.0, "B": 0.0, "C": 200.0}


def degrees(x: float, y: float) -> tuple[float, float]:
    """Return the approximate latitude and longitude of a position in metres from the centre."""
    return LAT + y / 111_200.0, LON + x / (111_200.0 * math.cos(math.radians(LAT)))


class Map:
    """Writes an OpenStreetMap extract."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._ways: list[str] = []
        self._next = 1

    def node(self, x: float, y: float, **tags: str) -> int:
        lat, lon = degrees(x, y)
        inside = "".join(f'<tag k="{k}" v="{v}"/>' for k, v in tags.items())
        self._lines.append(f'<node id="{self._next}" lat="{lat:.7f}" lon="{lon:.7f}">{inside}</node>')
        self._next += 1
        return self._next - 1

    def way(self, nodes: list[int], **tags: str) -> None:
        inside = "".join(f'<nd ref="{n}"/>' for n in nodes) + "".join(
            f'<tag k="{k}" v="{v}"/>' for k, v in tags.items()
        )
        self._ways.append(f'<way id="{1000 + len(self._ways)}">{inside}</way>')

    def square(self, x: float, y: float, half: float, **tags: str) -> None:
        corners = [self.node(x + dx * half, y + dy * half) for dx, dy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        self.way([*corners, corners[0]], building="yes", **tags)

    def write(self, path: Path) -> Path:
        path.write_text("\n".join(['<osm version="0.6">', *self._lines, *self._ways, "</osm>"]), encoding="utf-8")
        return path


@pytest.fixture(scope="module")
def extract(tmp_path_factory: pytest.TempPathFactory) -> Path:
    drawn = Map()
    signals = {"A": {"highway": "traffic_signals"}, "B": {"highway": "traffic_signals"}, "C": {}}
    middles = {name: drawn.node(x, 0, **signals[name]) for name, x in CROSSINGS.items()}
    for name, x in CROSSINGS.items():
        drawn.way([drawn.node(x, -150), middles[name], drawn.node(x, 150)], highway="residential", name=f"{name} Road")
    drawn.way([drawn.node(-400, 0), *middles.values(), drawn.node(400, 0)], highway="secondary", lanes="2", name="Main")
    drawn.square(-230, 30, 8, height="12")
    drawn.square(-200, 280, 8, height="12")  # more than 200 m from B's region, not from A's
    drawn.square(200, 0, 60)
    return drawn.write(tmp_path_factory.mktemp("map") / "town.osm")


@pytest.fixture(scope="module")
def made(extract: Path) -> creation.NewCity:
    return creation.create_city(extract.parent / "town", extract)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_selects_junctions_with_signals(made: creation.NewCity, extract: Path) -> None:
    city = model.load_city(made.folder)
    assert [j.title for j in city.junctions] == [f"signalised junction of {n} Road and Main" for n in "AB"]
    assert [j.id for j in city.junctions] == ["j01", "j02"] and all(j.signalised for j in city.junctions)
    for junction, name in zip(city.junctions, "AB", strict=True):
        lat, lon = degrees(CROSSINGS[name], 0)
        assert (junction.lat_deg, junction.lon_deg) == pytest.approx((lat, lon), abs=2e-5)
    summary = json.loads((made.folder / "import.json").read_text())
    assert {reason: len(ids) for reason, ids in summary["left_out"].items()} == {"without signals": 9}
    assert summary["junctions"] == {"made": 2, "signalised": 2} and "OpenStreetMap" in city.attribution


@pytest.mark.slow
def test_junction_has_region_and_poles_of_egvs_new(made: creation.NewCity, extract: Path) -> None:
    for junction in model.load_city(made.folder).junctions:
        in_city, single = made.folder / "junctions" / junction.id, made.folder.parent / f"single-{junction.id}"
        create_scenario(single, extract, (junction.lat_deg, junction.lon_deg), surroundings_m=math.inf)
        scenario, expected = egvs.load(in_city), egvs.load(single)
        without_zones = expected.score.model_copy(update={"zones": None})  # a city has none
        assert (scenario.roi, scenario.sites, scenario.score) == (expected.roi, expected.sites, without_zones)
        assert (in_city / "sites.csv").read_bytes() == (single / "sites.csv").read_bytes()

        near, all_solids = read_solids(in_city), read_solids(single)
        assert near.items() <= all_solids.items()
        (x, y, _), (width, depth, _) = scenario.roi.box.origin_m, scenario.roi.size_m
        region = box(x, y, x + width, y + depth)
        distance_m = {name: region.distance(shape(feature["geometry"])) for name, feature in all_solids.items()}
        assert {name for name in all_solids if distance_m[name] < 200} <= near.keys()  # the range of a VLP-32C
        assert {name for name in all_solids if distance_m[name] > 300}.isdisjoint(near)
        assert json.loads((single / "statics.geojson").read_text())["summary"]["dropped"]["out_of_range"]

        frame = geolocation.scenario_georeference(scenario).frame
        expected_frame = geolocation.scenario_georeference(expected).frame
        assert frame is not None and expected_frame is not None
        location = [[junction.x_m, junction.y_m]]
        assert frame.to_degrees(location) == pytest.approx(expected_frame.to_degrees(location), abs=1e-9)


def read_solids(folder: Path) -> dict[str, dict]:
    """Return the solids of a scenario by name."""
    features = json.loads((folder / "statics.geojson").read_text())["features"]
    return {feature["properties"]["name"]: feature for feature in features}


@pytest.mark.slow
def test_nearby_streets_give_same_poles_as_all_streets(extract: Path) -> None:
    read = osm.read_osm(extract)
    _, streets, _ = street_network.build_network(
        read, extract, street_network.netconvert_flags(read, lefthand=False, walk=True)
    )
    for junction in streets.junctions:
        roi = junctions.region_around(junction)
        near = streets.near(roi.area.buffer(60.0, join_style="mitre"))
        assert len(near.areas) < len(streets.areas)
        assert junctions.kerbside_poles(near, junction, roi, []) == junctions.kerbside_poles(streets, junction, roi, [])


@pytest.mark.slow
def test_network_excerpt_keeps_streets(extract: Path, tmp_path: Path) -> None:
    read = osm.read_osm(extract)
    text, streets, _ = street_network.build_network(
        read, extract, street_network.netconvert_flags(read, lefthand=False, walk=True)
    )
    excerpts, complete = network_excerpts.NetworkExcerpts(text), streets.network
    (tmp_path / "complete.net.xml").write_text(text)
    for junction in (junction for junction in streets.junctions if junction.arms >= 3):
        window = junctions.region_around(junction).area.buffer(80.0, join_style="mitre")
        path = tmp_path / "excerpt.net.xml"
        path.write_text(excerpts.near(streets.near(window)))
        excerpt = network.read_net_xml(path)
        assert excerpt.location == complete.location
        edges, all_edges = {e.id: e for e in excerpt.all_edges}, {e.id: e for e in complete.all_edges}
        assert len(edges) < len(all_edges)
        for edge_id, edge in edges.items():
            assert [lane.text for lane in edge.lanes] == [lane.text for lane in all_edges[edge_id].lanes]
        in_window = {edge_id for edge_id, area in streets.areas.items() if area.intersects(window)}
        assert {edge_id for edge_id in in_window if not edge_id.startswith(":")} <= edges.keys()
        inside = {edge_id for edge_id in all_edges if edge_id.startswith(f":{junction.id}_")}
        assert inside and inside <= edges.keys()  # lanes, crossings and walking areas of the junction
        assert {j.id for j in excerpt.junctions} >= {junction.id}
        expected = {connection for connection in connections(complete) if connection[0] in edges}
        assert connections(excerpt) == {connection for connection in expected if connection[1] in edges}


def connections(net: network.Network) -> set[tuple[str, str, str]]:
    """Return source, target and internal lane of all connections."""
    return {(net.edges[c.source].id, net.edges[c.target].id, c.via) for c in net.connections}


@pytest.mark.slow
def test_same_map_gives_same_bytes(made: creation.NewCity, extract: Path, tmp_path: Path) -> None:
    again = creation.create_city(tmp_path / "town", extract)
    assert contents(again.folder) == contents(made.folder)


@pytest.mark.slow
@pytest.mark.system
def test_city_of_a_zipped_map(made: creation.NewCity, extract: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "town.zip", "w") as archive:
        archive.write(extract, "town/map.osm")
    again = creation.create_city(tmp_path / "town", tmp_path / "town.zip")
    assert contents(again.folder) == contents(made.folder)
    assert not any(str(tmp_path) in note and "town.zip" not in note for note in again.notes)


@pytest.mark.slow
def test_leaves_out_junction_without_pole_locations(extract: Path, tmp_path: Path) -> None:
    city = creation.create_city(tmp_path / "town", extract, NewCityOptions(which="all"))
    assert [new.junction.names[0] for new in city.junctions] == ["A Road", "B Road"]
    assert len(city.left_out[creation.NO_FREE_KERB]) == 1


@pytest.mark.slow
def test_selects_junctions_of_table(extract: Path, tmp_path: Path) -> None:
    table = tmp_path / "junctions.csv"
    (lat, lon), (b_lat, b_lon) = degrees(-195, 5), degrees(0, 0)
    table.write_text(f"junction,lat_deg,lon_deg\nbridge,{b_lat},{b_lon}\ntower,{lat},{lon}\n")
    city = creation.create_city(tmp_path / "town", extract, NewCityOptions(which=str(table)))
    read = model.load_city(city.folder)
    assert [(j.id, j.title) for j in read.junctions] == [
        ("bridge", "signalised junction of B Road and Main"), ("tower", "signalised junction of A Road and Main"),
    ]  # fmt: skip
    again = creation.create_city(tmp_path / "again", extract, NewCityOptions(which=str(city.folder / "junctions.csv")))
    assert model.load_city(again.folder).junctions == read.junctions


@pytest.mark.slow
def test_radius_limits_streets_and_junctions(extract: Path, tmp_path: Path) -> None:
    city = creation.create_city(tmp_path / "town", extract, NewCityOptions(around=degrees(-200, 0), radius_m=250.0))
    assert [new.junction.names[0] for new in city.junctions] == ["A Road"]
    assert len(city.left_out["too near to the rim"]) == 1
    assert city.streets.lane_length_m < 2 * (500 + 300 + 300) + 50


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("tower,50.0,10.05", "line 2 (tower): the nearest junction of three or more streets is"),
        ("tower,10.0,50.0", "are swapped: did you mean lat_deg 50.0, lon_deg 10.0?"),
        ("tower,50.0,10.0\nother,50.0,10.00001", "line 3 (other): these coordinates select the same junction as tower"),
        ("tower,50.0,10.0\nTower,50.0,10.00001", "line 3 (Tower): this name occurs twice"),
        ("a/b,50.0,10.0", "line 2 (a/b): junction: invalid name 'a/b'"),
        ("", "junctions.csv: the table has no junctions"),
        ("tower,95,10.0", "line 2 (tower): lat_deg: expected a number from -90 to 90, got '95'"),
    ],
)
def test_rejects_wrong_row_of_table(extract: Path, tmp_path: Path, rows: str, message: str) -> None:
    table = tmp_path / "junctions.csv"
    table.write_text(f"junction,lat_deg,lon_deg\n{rows}\n")
    with pytest.raises(InputError) as caught:
        creation.create_city(tmp_path / "town", extract, NewCityOptions(which=str(table)))
    assert message in str(caught.value)
    assert not (tmp_path / "town").exists()


@pytest.mark.slow
def test_wrong_input_gives_one_message_and_creates_nothing(extract: Path, tmp_path: Path, run_egvs) -> None:
    out = tmp_path / "town"
    for options, message in (
        (["--radius", "2km"], "--radius: given without --around. Add --around LAT,LON"),
        (["--around", "50.0,10.0", "--radius", "2 miles"], "--radius: expected a length above 0, got '2 miles'"),
        (["--around", "51.0,10.0"], "--around: 51,10 is outside the extract"),
        (["--around", "10.0,50.0"], "Latitude comes first: did you mean --around 50.0,10.0?"),
        (["--around", "here"], "--around: expected LAT,LON in degrees, got 'here'"),
        (
            ["--junctions", "signalized"],
            "signalized: no such file. Give a table of junctions",
        ),
        (["--around", "50.0,10.0", "--radius", "90"], "too near to the rim"),
        (["--traffic", "dense"], "--traffic: expected light, medium or heavy, got 'dense'"),
    ):
        code, _, error = run_egvs("city", "new", out, "--osm", extract, *options)
        assert code == 2 and message in error, (options, error)
        assert not out.exists()
    out.mkdir()
    (out / "mine").touch()
    code, _, error = run_egvs("city", "new", out, "--from", extract)
    assert code == 2 and "not empty" in error


@pytest.mark.slow
def test_traffic_level_is_a_share_of_what_the_network_carries(
    extract: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_egvs
) -> None:
    capacity = FlowCapacity(2000, True, (FlowTrial(2000, True, 100.0, 0, 0.0),))
    monkeypatch.setattr(creation, "find_flow", lambda *_: capacity)
    for level, expected in (("light", 800), ("medium", 1500), ("heavy", 2000)):
        folder = tmp_path / level
        code, printed, error = run_egvs("city", "new", folder, "--osm", extract, "--traffic", level)
        assert code == 0, error
        assert f"carries 2,000 vehicles an hour; {level} {expected // 20} % is used" in printed + error
        assert model.load_city(folder).traffic.vehicles_per_h == expected


@pytest.mark.slow
def test_from_map_to_scores(extract: Path, tmp_path: Path, run_egvs) -> None:
    code, printed, error = run_egvs("city", "new", tmp_path / "town", "--osm", extract, "--walk")
    assert code == 0, error
    assert "j02" in printed and "next: egvs city run" in printed
    file = tmp_path / "town" / "city.toml"
    text = file.read_text()
    for old, now in (
        ("frames = 5000", "frames = 40"),
        ("warmup_s = 300.0", "warmup_s = 60.0"),
        ("vehicles_per_h = ", "vehicles_per_h = 2000 # not "),
    ):
        assert old in text
        text = text.replace(old, now)
    file.write_text(text + "\n[effects.pedestrians_bicycles]\npedestrians_per_h = 2000\n")
    code, printed, error = run_egvs("city", "traffic", tmp_path / "town")
    assert code == 0, error
    assert "frames: 40" in printed
    before = contents(tmp_path / "town" / "traffic")
    assert {"j01.parquet", "j02.parquet", "traffic.json", "sumo/run.sumocfg"} <= before.keys()
    code, printed, _ = run_egvs("city", "traffic", tmp_path / "town")
    assert code == 0 and "nothing to do" in printed
    assert contents(tmp_path / "town" / "traffic") == before
    folder = tmp_path / "town" / "junctions" / "j01"
    code, _, error = run_egvs("check", folder)
    assert code == 0, error
    summary = run_stage(traffic, egvs.load(folder), tmp_path / "run")
    assert summary["frames"] == 40
    boxes = egvs.read_trajectories(tmp_path / "run" / "trajectories.parquet")
    assert {"pedestrian", "passenger"} <= set(boxes["kind"].to_pylist())
    overrides = ["sites.heights_m=[4.5]", "sites.pitch_deg=['aim']", "sites.sensor='VLP-16'", "roi.voxel_m=1"]
    egvs.run(egvs.load(folder, overrides), tmp_path / "run", jobs=1)
    spots, _ = parquet.read_artefact(tmp_path / "run" / "blindspots.parquet", "blindspots")
    assert "lane" in spots["by"].to_pylist()
    assert "A Road" in (tmp_path / "run" / "report.html").read_text()
    city = model.load_city(tmp_path / "town")
    (tmp_path / "town" / "traffic" / traffic_split.RECORD_FILE).unlink()
    assert traffic_split.make_city_traffic(city).is_new  # SUMO runs again: the same bytes
    again = contents(tmp_path / "town" / "traffic")
    assert all(again[name] == before[name] for name in before if name.endswith(".parquet"))


@pytest.fixture(scope="module")
def close_junctions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map with three signalised junctions: the middle one has more lanes, and the next one is 45 m to the east."""
    drawn = Map()
    positions = (-200.0, 0.0, 45.0)
    middles = [drawn.node(x, 0, highway="traffic_signals") for x in positions]
    for x, middle, lanes in zip(positions, middles, ("2", "4", "2"), strict=True):
        ends = drawn.node(x, -150), middle, drawn.node(x, 150)
        drawn.way(list(ends), highway="residential", name=f"Road {x:g}", lanes=lanes)
    drawn.way([drawn.node(-400, 0), *middles, drawn.node(400, 0)], highway="secondary", lanes="2", name="Main")
    return drawn.write(tmp_path_factory.mktemp("map") / "town.osm")


@pytest.mark.slow
def test_overlapping_regions_are_divided(close_junctions: Path, tmp_path: Path) -> None:
    made = creation.create_city(tmp_path / "town", close_junctions)
    kept = [junction.junction.title.split(" of ")[1] for junction in made.junctions]
    assert kept == ["Main and Road 0", "Main and Road -200", "Main and Road 45"]
    assert creation.OVERLAPPING_REGION not in made.left_out
    regions = [junction.roi.area for junction in made.junctions]
    assert all(a.intersection(b).area == 0.0 for a, b in combinations(regions, 2))
    uncut = [junctions.region_around(junction.junction).area for junction in made.junctions]
    assert shapely.union_all(regions).equals(shapely.union_all(uncut))
    assert sum(region.area for region in regions) < sum(region.area for region in uncut)


def square_junction(name: str, x_m: float, y_m: float, side_m: float = 16.0) -> StreetJunction:
    area = shapely.box(x_m - side_m / 2, y_m - side_m / 2, x_m + side_m / 2, y_m + side_m / 2)
    return StreetJunction(name, (x_m, y_m), area, 4, 4, True, ())


def test_regions_are_cut_in_the_middle_of_their_overlap() -> None:
    """Regions of 60 m: from -30 to 30 and from 15 to 75. A third overlaps only the second, from above."""
    chosen = {"a": square_junction("a", 0, 0), "b": square_junction("b", 45, 0), "c": square_junction("c", 62, 50)}
    regions = {name: region.area.bounds for name, region in creation.divided_regions(chosen).regions.items()}
    assert regions == {"a": (-30, -30, 22, 30), "b": (22, -30, 75, 25), "c": (32, 25, 92, 80)}


def test_junctions_that_no_line_divides_are_named() -> None:
    chosen = {"a": square_junction("a", 0, 0), "b": square_junction("b", 10, 10), "c": square_junction("c", 90, 0)}
    divided = creation.divided_regions(chosen)
    assert divided.too_near == {"b": "a"}
    assert divided.regions == {name: junctions.region_around(chosen[name]) for name in ("a", "c")}


@pytest.fixture
def undivided(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the first junction gets a region."""

    def regions(chosen: Mapping[str, StreetJunction]) -> creation.DividedRegions:
        first, *others = chosen
        return creation.DividedRegions({first: junctions.region_around(chosen[first])}, dict.fromkeys(others, first))

    monkeypatch.setattr(creation, "divided_regions", regions)


@pytest.mark.slow
@pytest.mark.usefixtures("undivided")
def test_leaves_out_junction_too_near_to_larger_one(close_junctions: Path, tmp_path: Path) -> None:
    made = creation.create_city(tmp_path / "town", close_junctions)
    assert [junction.id for junction in made.junctions] == ["j01"]
    assert len(made.left_out[creation.OVERLAPPING_REGION]) == 2
    summary = json.loads((made.folder / "import.json").read_text())
    assert summary["left_out"][creation.OVERLAPPING_REGION] == made.left_out[creation.OVERLAPPING_REGION]


@pytest.mark.slow
@pytest.mark.usefixtures("undivided")
def test_rejects_rows_of_junctions_that_no_line_divides(close_junctions: Path, tmp_path: Path) -> None:
    table = tmp_path / "mine.csv"
    rows = [",".join([name, *map(str, degrees(x, 0))]) for name, x in (("small", 45.0), ("large", 0.0))]
    table.write_text("\n".join(["junction,lat_deg,lon_deg", *rows, ""]))
    with pytest.raises(InputError) as caught:
        creation.create_city(tmp_path / "town", close_junctions, NewCityOptions(which=str(table)))
    message = str(caught.value)
    assert message.startswith(f"{table}: junctions small and large: no line divides their regions of interest")
    assert "Remove one of the two rows." in message
    assert not (tmp_path / "town").exists()


@pytest.mark.slow
def test_city_gets_the_side_and_the_turns_of_the_map(tmp_path: Path) -> None:
    path = ring_map(tmp_path / "england.osm", 52.5, -1.5, clockwise=True)
    city = creation.create_city(tmp_path / "city", path, NewCityOptions(which="all"))
    assert 'lefthand="true"' in (tmp_path / "city" / "network.net.xml").read_text(encoding="utf-8")
    assert city.notes[0].startswith("Traffic drives on the left: the one-way ring (way 1) runs clockwise")
    with pytest.raises(InputError, match=r"england\.osm: is for left-hand traffic"):
        creation.create_city(tmp_path / "other", path, NewCityOptions(which="all", righthand=True))
    draft, ways = divided_road()
    draft.restrict("no_left_turn", ways["middle"], draft.via((0.0, -APART_M)), ways["to east"])
    street_network._write_streets(draft.extract(), tmp_path / "turns.osm", ())
    city = creation.create_city(tmp_path / "turns", tmp_path / "turns.osm", NewCityOptions(which="all"))
    assert any(note.startswith("1 turn that the map does not permit was closed") for note in city.notes)
