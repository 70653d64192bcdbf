"""A city is made from a map: which junctions it has, what their scenarios hold, and what is told when it cannot be.

The map is a street from west to east with three crossings 200 m apart: A and B with signals, C without, where a large
building takes all kerbs. What a junction's scenario holds is checked against ``egvs new`` of that junction alone."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from shapely.geometry import box, shape

import egvs
from egvs.artefacts import parquet
from egvs.city import creation, model, traffic_split
from egvs.core.errors import InputError
from egvs.formats import osm
from egvs.importers import junctions, openstreetmap, osm_network
from egvs.stages import traffic
from egvs.traffic import network
from egvs.world import geolocation
from tests.stages import run_stage

pytestmark = pytest.mark.system
LAT, LON = 50.0, 10.0
CROSSINGS = {"A": -200.0, "B": 0.0, "C": 200.0}


def degrees(x: float, y: float) -> tuple[float, float]:
    """Latitude and longitude of metres east and north of the middle, about."""
    return LAT + y / 111_200.0, LON + x / (111_200.0 * math.cos(math.radians(LAT)))


class Map:
    """Writes an extract."""

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
        path.write_text("\n".join(['<osm version="0.6">', *self._lines, *self._ways, "</osm>"]))
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


def test_a_city_has_every_junction_with_signals(made: creation.NewCity, extract: Path) -> None:
    city = model.load_city(made.folder)
    assert [j.title for j in city.junctions] == [f"signalised junction of {n} Road and Main" for n in "AB"]
    assert [j.id for j in city.junctions] == ["j01", "j02"] and all(j.signalised for j in city.junctions)
    for junction, name in zip(city.junctions, "AB", strict=True):
        lat, lon = degrees(CROSSINGS[name], 0)
        assert (junction.lat_deg, junction.lon_deg) == pytest.approx((lat, lon), abs=2e-5)
    counted = json.loads((made.folder / "import.json").read_text())
    assert {why: len(ids) for why, ids in counted["left_out"].items()} == {"without signals": 9}
    assert counted["junctions"] == {"made": 2, "signalised": 2} and "OpenStreetMap" in city.attribution


@pytest.mark.slow
def test_a_junction_has_the_region_and_the_poles_that_it_has_alone(made: creation.NewCity, extract: Path) -> None:
    for its in model.load_city(made.folder).junctions:
        folder = made.folder.parent / f"alone-{its.id}"
        openstreetmap.create_scenario(folder, extract, (its.lat_deg, its.lon_deg), surroundings_m=None)
        ours, alone = egvs.load(made.folder / "junctions" / its.id), egvs.load(folder)
        assert (ours.roi, ours.sites, ours.score) == (alone.roi, alone.sites, alone.score)
        assert (made.folder / "junctions" / its.id / "sites.csv").read_bytes() == (folder / "sites.csv").read_bytes()
        near, every = (
            {f["properties"]["name"]: f for f in json.loads((its_folder / "statics.geojson").read_text())["features"]}
            for its_folder in (made.folder / "junctions" / its.id, folder)
        )
        assert near.items() <= every.items()
        (x, y, _), (width, depth, _) = ours.roi.box.origin_m, ours.roi.size_m
        region = box(x, y, x + width, y + depth)
        away_m = {name: region.distance(shape(feature["geometry"])) for name, feature in every.items()}
        assert {name for name in every if away_m[name] < 200} <= near.keys()  # the reach of a VLP-32C
        assert {name for name in every if away_m[name] > 300}.isdisjoint(near) and len(near) < len(every)
        mine, networks = geolocation.scenario_georeference(ours).frame, geolocation.scenario_georeference(alone).frame
        assert mine is not None and networks is not None
        spot = [[its.x_m, its.y_m]]
        assert mine.to_degrees(spot) == pytest.approx(networks.to_degrees(spot), abs=1e-9)


def test_near_streets_give_the_same_kerbs_as_all(extract: Path) -> None:
    read = osm.read_osm(extract)
    _, streets = osm_network.build_network(read, extract, osm_network.netconvert_flags(read, lefthand=False, walk=True))
    for junction in streets.junctions:
        roi = junctions.region_around(junction)
        near = streets.near(roi.area.buffer(60.0, join_style="mitre"))
        assert len(near.areas) < len(streets.areas)
        assert junctions.kerbside_poles(near, junction, roi, []) == junctions.kerbside_poles(streets, junction, roi, [])


def test_a_part_of_a_network_has_its_streets_as_they_are(extract: Path, tmp_path: Path) -> None:
    read = osm.read_osm(extract)
    text, streets = osm_network.build_network(
        read, extract, osm_network.netconvert_flags(read, lefthand=False, walk=True)
    )
    pieces, whole = osm_network.NetworkExcerpts(text), streets.network
    (tmp_path / "whole.net.xml").write_text(text)
    for junction in (junction for junction in streets.junctions if junction.arms >= 3):
        window = junctions.region_around(junction).area.buffer(80.0, join_style="mitre")
        path = tmp_path / "part.net.xml"
        path.write_text(pieces.near(streets.near(window)))
        part = network.read_net_xml(path)
        assert part.location == whole.location
        ours, all_edges = {e.id: e for e in part.all_edges}, {e.id: e for e in whole.all_edges}
        assert len(ours) < len(all_edges)
        for its_id, edge in ours.items():
            assert [lane.text for lane in edge.lanes] == [lane.text for lane in all_edges[its_id].lanes]
        reached = {its for its, area in streets.areas.items() if area.intersects(window) and not its.startswith(":")}
        assert reached <= ours.keys()
        inside = {its for its in all_edges if its.startswith(f":{junction.id}_")}
        assert inside and inside <= ours.keys()  # lanes, crossings and walking areas of the junction
        assert {j.id for j in part.junctions} >= {junction.id}
        mine = {(part.edges[c.source].id, part.edges[c.target].id, c.via) for c in part.connections}
        every = {(whole.edges[c.source].id, whole.edges[c.target].id, c.via) for c in whole.connections}
        assert mine == {c for c in every if c[0] in ours and c[1] in ours}


def test_the_same_map_gives_the_same_bytes(made: creation.NewCity, extract: Path, tmp_path: Path) -> None:
    again = creation.create_city(tmp_path / "town", extract)
    assert contents(again.folder) == contents(made.folder)


def test_a_junction_without_a_free_place_is_left_out_and_told(extract: Path, tmp_path: Path) -> None:
    city = creation.create_city(tmp_path / "town", extract, which="all")
    assert [its.junction.names[0] for its in city.junctions] == ["A Road", "B Road"]
    assert len(city.left_out[creation.NO_FREE_KERB]) == 1


@pytest.mark.slow
def test_a_table_names_the_junctions(extract: Path, tmp_path: Path) -> None:
    table = tmp_path / "wanted.csv"
    (lat, lon), (b_lat, b_lon) = degrees(-195, 5), degrees(0, 0)
    table.write_text(f"junction,lat_deg,lon_deg\nbridge,{b_lat},{b_lon}\ntower,{lat},{lon}\n")
    city = creation.create_city(tmp_path / "town", extract, which=str(table))
    read = model.load_city(city.folder)
    assert [(j.id, j.title) for j in read.junctions] == [
        ("bridge", "signalised junction of B Road and Main"), ("tower", "signalised junction of A Road and Main"),
    ]  # fmt: skip
    again = creation.create_city(tmp_path / "again", extract, which=str(city.folder / "junctions.csv"))
    assert model.load_city(again.folder).junctions == read.junctions


def test_a_circle_bounds_streets_and_junctions(extract: Path, tmp_path: Path) -> None:
    city = creation.create_city(tmp_path / "town", extract, around=degrees(-200, 0), radius_m=250.0)
    assert [its.junction.names[0] for its in city.junctions] == ["A Road"]
    assert len(city.left_out["too near to the rim"]) == 1
    assert city.streets.lane_length_m < 2 * (500 + 300 + 300) + 50


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ("tower,50.0,10.05", "junction tower: no junction of three streets or more is there (the nearest is"),
        ("tower,50.0,10.0\nother,50.0,10.00001", "junction other: is the same junction as tower"),
        ("tower,50.0,10.0\nTower,50.0,10.00001", "junction Tower: stands there twice"),
        ("a/b,50.0,10.0", "junction a/b: junction: 'a/b'. Use a name"),
        ("", "wanted.csv: names no junction; a row for each"),
        ("tower,95,10.0", "junction tower: lat_deg: '95'; a number from -90 to 90"),
    ],
)
def test_a_wrong_row_of_a_table_is_named(extract: Path, tmp_path: Path, rows: str, told: str) -> None:
    table = tmp_path / "wanted.csv"
    table.write_text(f"junction,lat_deg,lon_deg\n{rows}\n")
    with pytest.raises(InputError) as caught:
        creation.create_city(tmp_path / "town", extract, which=str(table))
    assert told in str(caught.value)
    assert not (tmp_path / "town").exists()


@pytest.mark.slow
def test_wrong_input_is_one_message_and_leaves_nothing(extract: Path, tmp_path: Path, run_egvs) -> None:
    out = tmp_path / "town"
    for options, told in (
        (["--radius", "2km"], "--radius: 2000 m round no place; --around LAT,LON as well"),
        (["--around", "50.0,10.0", "--radius", "2 miles"], "--radius: expected a length above 0, got '2 miles'"),
        (["--around", "51.0,10.0"], "--around: 51,10 is outside the extract"),
        (["--around", "here"], "--around: expected LAT,LON in degrees, got 'here'"),
        (["--junctions", "signalized"], "signalized: no such file; a table with the columns junction, lat_deg"),
        (["--around", "50.0,10.0", "--radius", "90"], "too near to the rim"),
    ):
        code, _, said = run_egvs("city", "new", out, "--osm", extract, *options)
        assert code == 2 and told in said, (options, said)
        assert not out.exists()
    out.mkdir()
    (out / "mine").touch()
    code, _, said = run_egvs("city", "new", out, "--osm", extract)
    assert code == 2 and "not empty" in said


def test_from_a_map_to_a_junctions_scores(extract: Path, tmp_path: Path, run_egvs) -> None:
    code, printed, said = run_egvs("city", "new", tmp_path / "town", "--osm", extract, "--walk")
    assert code == 0, said
    assert "j02" in printed and "next: egvs city traffic" in printed
    file = tmp_path / "town" / "city.toml"
    text = file.read_text()
    for old, now in (
        ("frames = 5000", "frames = 40"),
        ("warmup_s = 300.0", "warmup_s = 60.0"),
        ("_km = 4.0", "_km = 9.0"),
    ):
        assert old in text
        text = text.replace(old, now)
    file.write_text(text + "\n[effects.pedestrians_bicycles]\npedestrians_per_h = 2000\n")
    code, printed, said = run_egvs("city", "traffic", tmp_path / "town")
    assert code == 0, said
    assert "frames: 40" in printed
    before = contents(tmp_path / "town" / "traffic")
    assert {"j01.parquet", "j02.parquet", "traffic.json", "sumo/run.sumocfg"} <= before.keys()
    code, printed, _ = run_egvs("city", "traffic", tmp_path / "town")
    assert code == 0 and "nothing to do" in printed
    assert contents(tmp_path / "town" / "traffic") == before
    folder = tmp_path / "town" / "junctions" / "j01"
    code, _, said = run_egvs("check", folder)
    assert code == 0, said
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
    (tmp_path / "town" / "traffic" / traffic_split.SEAL_FILE).unlink()
    assert traffic_split.make_city_traffic(city).is_new  # SUMO runs again: the same bytes
    again = contents(tmp_path / "town" / "traffic")
    assert all(again[name] == before[name] for name in before if name.endswith(".parquet"))
