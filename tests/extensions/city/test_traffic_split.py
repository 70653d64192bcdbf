"""The traffic of a city: junctions get the same results as from the complete traffic; interrupted and repeated runs."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.core.errors import InputError, RunError
from egvs.extensions.city import traffic_split
from egvs.extensions.city.model import City, load_city
from egvs.traffic import fcd, sumo
from tests.extensions.city.conftest import FRAMES
from tests.stages.conftest import net_xml

pytestmark = pytest.mark.system
ARTICULATED = "\n[effects.articulated]\nkinds = { bus = { parts_m = [9.0, 8.0] } }\n"


def edit(path: Path, text: str, old: str = "") -> None:
    """Replace ``old`` in a file by ``text``, or append ``text``."""
    before = path.read_text(encoding="utf-8")
    assert old in before
    path.write_text(before.replace(old, text) if old else before + text, encoding="utf-8")


def contents(city: City) -> dict[str, bytes]:
    """Return the traffic files of all junctions."""
    return {path.name: path.read_bytes() for path in (city.folder / "traffic").glob("*.parquet")}


def make_unsplit_traffic(city: City, name: str, monkeypatch: pytest.MonkeyPatch) -> bytes:
    """Make the traffic of a junction with all vehicles of the city; return its file."""
    regions = traffic_split.find_traffic_regions(city)
    regions[name] = replace(regions[name], low_x_m=-1e4, low_y_m=-1e4, high_x_m=1e4, high_y_m=1e4)
    with monkeypatch.context() as patch:
        patch.setattr(traffic_split, "find_traffic_regions", lambda *_: regions)
        assert traffic_split.make_city_traffic(city).rows[name] == 3 * FRAMES
    return city.junction(name).traffic_file(city).read_bytes()


@pytest.mark.slow
def test_junctions_have_all_frames_even_empty_ones(city: City) -> None:
    made = traffic_split.make_city_traffic(city)
    assert made.is_new and made.frames == FRAMES
    for junction in city.junctions:
        scenario = egvs.load(junction.scenario_folder(city))
        record = egvs.run(scenario, city.folder / "run" / junction.id, jobs=1)
        assert record.stages["traffic"].summary["frames"] == FRAMES
        assert egvs.read_tpog(city.folder / "run" / junction.id / "tpog.parquet").frames == FRAMES
    assert made.rows == {"west": 86, "east": 7}
    few = egvs.read_trajectories(city.folder / "run" / "east" / "trajectories.parquet")
    assert set(few["vehicle"].to_pylist()) == {"far"}
    assert few["frame"].to_pylist() == list(range(min(few["frame"].to_pylist()), max(few["frame"].to_pylist()) + 1))


@pytest.mark.slow
@pytest.mark.parametrize("effects", ["", ARTICULATED + "[effects.moving_occlusion]\n"])
def test_results_equal_those_from_all_vehicles(city: City, effects: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Boxes near the region, TPOG and scores are equal to the last bit, even of a bus that bends along its path."""
    folder = city.junctions[0].scenario_folder(city)
    edit(folder / "scenario.toml", effects + '\n[score]\nrank_by = "expected_detections"\n', "\n[score]\n")
    unsplit = make_unsplit_traffic(city, "west", monkeypatch)
    runs = {}
    for way in ("all", "split"):
        if way == "split":
            (city.folder / "traffic" / traffic_split.RECORD_FILE).unlink()
            assert traffic_split.make_city_traffic(city).is_new
            assert city.junctions[0].traffic_file(city).read_bytes() != unsplit
        egvs.run(egvs.load(folder), city.folder / way, jobs=1)
        runs[way] = city.folder / way
    boxes = {way: near(egvs.read_trajectories(run / "trajectories.parquet")) for way, run in runs.items()}
    assert boxes["split"].num_rows > 60 and boxes["split"].equals(boxes["all"])
    if effects:
        assert boxes["split"]["part"].to_numpy().max() == 1
    for artefact in ("tpog", "scores", "scans", "blindspots"):
        split = parquet.read_artefact(runs["split"] / f"{artefact}.parquet", artefact)
        unsplit = parquet.read_artefact(runs["all"] / f"{artefact}.parquet", artefact)
        assert split[0].num_rows and split[0].to_pandas().equals(unsplit[0].to_pandas()), artefact  # NaN is NaN
        for metadata in (split[1], unsplit[1]):
            del metadata["inputs"]  # the files' hashes
        assert split[1] == unsplit[1]


def near(boxes: pa.Table) -> pa.Table:
    """Return the boxes within 60 m of the western region; other boxes differ."""
    x, y = boxes["x_m"].to_numpy(), boxes["y_m"].to_numpy()
    return boxes.filter(pa.array((np.abs(x - 20) < 80) & (np.abs(y) < 70))).combine_chunks()


def test_keeps_every_box_that_may_be_in_region(city: City) -> None:
    """Compared with points in 4000 random boxes."""
    rng = np.random.default_rng(5)
    n = 4000
    x, y, angle = rng.uniform(-400, 400, n), rng.uniform(-400, 400, n), np.radians(rng.uniform(0, 360, n))
    length, width = rng.uniform(0.5, 30, n), rng.uniform(0.5, 4, n)
    region = traffic_split.find_traffic_regions(city)["west"]
    is_selected = region.may_contain(x, y, np.hypot(length, width))
    low_x, low_y, high_x, high_y = region.to_json()
    assert (low_x, low_y, high_x, high_y) == (-60.0, -80.0, 100.0, 80.0)
    is_inside = np.zeros(n, dtype=bool)
    for along in np.linspace(0, 1, 61):
        for across in np.linspace(-0.5, 0.5, 9):
            px = x - along * length * np.sin(angle) + across * width * np.cos(angle)
            py = y - along * length * np.cos(angle) - across * width * np.sin(angle)
            is_inside |= (px >= low_x) & (px <= high_x) & (py >= low_y) & (py <= high_y)
    assert is_inside.sum() > 100 and (~is_selected).sum() > 1000
    assert not (is_inside & ~is_selected).any()


def test_repeats_only_what_changed(city: City) -> None:
    first = traffic_split.make_city_traffic(city)
    assert first.is_new and not traffic_split.make_city_traffic(city).is_new
    before = contents(city)
    assert traffic_split.make_city_traffic(city) == replace(first, is_new=False)
    (city.folder / "traffic" / "east.parquet").write_bytes(b"altered")
    assert traffic_split.make_city_traffic(city).is_new and contents(city) == before
    (city.folder / "traffic" / "west.parquet").unlink()
    assert traffic_split.make_city_traffic(city).is_new and contents(city) == before
    (city.folder / "traffic" / traffic_split.RECORD_FILE).write_text("[]")
    assert traffic_split.make_city_traffic(city).is_new and contents(city) == before
    moved = load_city(city.folder.rename(city.folder.parent / "elsewhere"))
    assert not traffic_split.make_city_traffic(moved).is_new
    moved.folder.rename(city.folder)
    edit(city.folder / "junctions" / "west" / "sites.csv", "pole_c,12,12,3\n")  # inside the rectangle
    assert not traffic_split.make_city_traffic(city).is_new
    edit(city.folder / "junctions" / "west" / "sites.csv", "pole_d,12,60,3\n")
    assert traffic_split.make_city_traffic(city).is_new
    edit(city.folder / "city.toml", "frames = 50", "frames = 60")
    assert traffic_split.make_city_traffic(load_city(city.folder)).frames == 50


def test_interrupted_command_changes_nothing(city: City, monkeypatch: pytest.MonkeyPatch) -> None:
    traffic_split.make_city_traffic(city)
    before = contents(city)
    edit(city.folder / "city.toml", "seed = 8", "seed = 7")
    again = load_city(city.folder)

    class Killed(BaseException):
        pass

    def kill(_what: str, done: int, _total: int) -> None:
        if done >= 40:
            raise Killed

    with pytest.raises(Killed):
        traffic_split.make_city_traffic(again, kill)
    names = sorted(path.name for path in (city.folder / "traffic").iterdir())
    assert names == [".lock", "east.parquet", "traffic.json", "west.parquet"]  # those from before
    assert contents(city) == before
    assert traffic_split.make_city_traffic(again).is_new
    assert contents(city) == before  # the seed changes nothing in a finished file


def test_files_are_fcd_as_sumo_writes_it(city: City) -> None:
    traffic_split.make_city_traffic(city)
    path = city.folder / "traffic" / "west.parquet"
    plain = pq.read_table(path).replace_schema_metadata()
    rows = {(t, name): (x, y) for t, name, x, y in zip(*(plain[c].to_pylist() for c in plain.column_names[:2]),
            *(plain[c].to_pylist() for c in ("vehicle_x", "vehicle_y")), strict=True)}  # fmt: skip
    lines = (city.folder / "fcd.csv").read_text().splitlines()[1:]
    all_rows = {(float(t), name): (float(x), float(y)) for t, name, x, y, *_ in (line.split(";") for line in lines)}
    assert rows.items() <= all_rows.items()
    assert sum(table.num_rows for table in fcd.read_fcd(path)) == len(rows) == 86


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("junctions/west/scenario.toml", "../../traffic/west.parquet", "mine.parquet",
         'fcd = "../../traffic/west.parquet"'),
        ("junctions/west/scenario.toml", "frame_period_s = 0.5", "periods = 3",
         "scenario.toml: traffic.periods: expected a list, got 3"),
        ("junctions/west/scenario.toml", "frame_period_s = 0.5", "frame_period_s = 0.75",
         "traffic.frame_period_s: expected a multiple of 0.5 s"),
        ("junctions/east/scenario.toml", "gamma = 4", "gamma = -4", "score.gamma"),
        ("city.toml", "frames = 60", "frames = 61", "city.toml: traffic: frames = 61: fcd.csv has 60 frames"),
        ("city.toml", "[[traffic.kinds]]", '[[traffic.periods]]\nname = "a/b"\n\n[[traffic.kinds]]',
         "city.toml: traffic.periods.0.name: expected a name, got 'a/b'"),
        ("city.toml", "seed = 7", "seed = 7\n[effects.rain]\nrate_mm_h = 20.0\n",
         "city.toml: effects.rain: adds no traffic. Move it to junctions/scenario.toml"),
        ("city.toml", 'name = "bus"', 'name = "coach"', "types in fcd.csv are unknown: 'bus'"),
    ],
)  # fmt: skip
def test_rejects_wrong_input(city: City, file: str, old: str, new: str, message: str) -> None:
    path = city.folder / file
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        traffic_split.make_city_traffic(load_city(city.folder))
    assert message in str(caught.value)
    assert not list((city.folder / "traffic").glob("*.parquet"))


PERIODS = """
[[traffic.periods]]
name = "day"
weight = 3.0

[[traffic.periods]]
name = "night"
fcd = "night.csv"
length_s = 20.0
"""


@pytest.mark.slow
def test_splits_each_period(city: City) -> None:
    toml, night = city.folder / "city.toml", city.folder / "night.csv"
    scenario_file, plain = city.junctions[0].scenario_folder(city) / "scenario.toml", toml.read_text()
    edit(scenario_file, "[traffic] # the city's\n", "[traffic]\n")
    before = scenario_file.read_text()
    night.write_text((city.folder / "fcd.csv").read_text())
    toml.write_text(plain.replace("[[traffic.kinds]]", PERIODS + "\n[[traffic.kinds]]", 1))
    made = traffic_split.make_city_traffic(load_city(city.folder))
    assert made.is_new and made.linked == ("west", "east") and made.frames == FRAMES + 40
    assert made.rows["west"] == sum(
        pq.read_metadata(city.folder / "traffic" / "periods" / name / "west.parquet").num_rows
        for name in ("day", "night")
    )
    assert (
        "[traffic] # the city's" in scenario_file.read_text()
        and 'fcd = "../../traffic/periods/day/west.parquet"' in scenario_file.read_text()
    )
    record = egvs.run(egvs.load(scenario_file.parent), city.folder / "run", jobs=1)
    assert {name: s["frames"] for name, s in record.stages["traffic"].summary["periods"].items()} == {
        "day": FRAMES, "night": 40,
    }  # fmt: skip
    by_period = egvs.read_scores_by_period(city.folder / "run" / "scores_by_period.parquet")
    assert set(by_period["period"].to_pylist()) == {"day", "night"}
    again = traffic_split.make_city_traffic(load_city(city.folder))
    assert not again.is_new and not again.linked
    toml.write_text(plain)
    back = traffic_split.make_city_traffic(load_city(city.folder))
    assert back.linked == ("west", "east")
    assert scenario_file.read_text().replace("\n\n", "\n") == reordered(before)
    assert (city.folder / "traffic" / "west.parquet").is_file()


def reordered(text: str) -> str:
    """Return the scenario with ``fcd`` behind the other keys of its table, and no empty lines."""
    fcd_line = next(line for line in text.splitlines() if line.startswith("fcd = "))
    text = text.replace(f"{fcd_line}\n", "").replace("frame_period_s = 0.5\n", f"frame_period_s = 0.5\n{fcd_line}\n")
    return text.replace("\n\n", "\n")


def test_overrides_may_need_more_traffic(city: City) -> None:
    traffic_split.make_city_traffic(city)
    same_region = ["effects.rain.rate_mm_h=20", "score.gamma=3"]
    assert not traffic_split.make_city_traffic(city, overrides=same_region).is_new
    larger_region = ["roi.center_m=[20, 100, 2.5]", "roi.size_m=[40, 300, 5]"]
    assert traffic_split.make_city_traffic(city, overrides=larger_region).is_new
    complete_paths = ["effects.articulated.kinds={bus={parts_m=[9.0, 8.0]}}"]
    assert traffic_split.make_city_traffic(city, overrides=complete_paths).rows["east"] == FRAMES + 7


def test_does_not_change_scenario_with_other_traffic(city: City) -> None:
    path = city.junctions[0].scenario_folder(city) / "scenario.toml"
    edit(path, 'fcd = "mine.csv"', 'fcd = "../../traffic/west.parquet"')
    text = path.read_text()
    with pytest.raises(InputError, match=r"comes from mine\.csv, not from the city's files"):
        traffic_split.make_city_traffic(city)
    assert path.read_text() == text


def test_warns_about_flat_junction_in_hilly_network(city: City) -> None:
    """Only the eastern junction names the network, which has heights, as its roads."""
    hill = net_xml().replace("-40,-1.60 80,-1.60", "-40,-1.60,0 580,-1.60,9")
    (city.folder / "net.net.xml").write_text(hill)
    edit(city.folder / "city.toml", 'roads = "net.net.xml"\nfcd =', "fcd =")
    edit(city.junctions[1].scenario_folder(city) / "scenario.toml", 'roads = "../../net.net.xml"\nfcd =', "fcd =")
    warnings = traffic_split.make_city_traffic(load_city(city.folder)).summary["warnings"]
    problems = [warning["problem"] for warning in warnings if warning["rule"] == "relief"]
    assert problems == ["the network has slopes, but the ground of west is level, because they name no roads"]


def test_traffic_of_junction_keeps_heights(city: City) -> None:
    """The town lies on a hill: rows of a junction have the z and the slope of the town's rows."""
    path = city.folder / "fcd.csv"
    header, *rows = path.read_text().splitlines()
    lifted = []
    for row in rows:
        x_m = float(row.split(";")[2])
        lifted.append(f"{row};{100 + x_m / 10:.6f};{5.710593}")
    path.write_text("\n".join([f"{header};vehicle_z;vehicle_slope", *lifted]) + "\n")
    traffic_split.make_city_traffic(city)
    for name in ("west", "east"):
        (table,) = fcd.read_fcd(city.folder / "traffic" / f"{name}.parquet")
        assert table.num_rows > 0
        assert table["z"].to_numpy() == pytest.approx(100 + table["x"].to_numpy() / 10, abs=1e-6)
        assert set(table["slope"].to_pylist()) == {5.710593}


def test_rejects_second_process(city: City) -> None:
    def start_another(_what: str, _done: int, _total: int) -> None:
        with pytest.raises(RunError, match="another run is using this folder"):
            traffic_split.make_city_traffic(city)

    assert traffic_split.make_city_traffic(city, start_another).is_new


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"frames": 0}, "invalid metadata: frames = 0"),
        ({"types": {"car": {"length_m": -1, "width_m": 1, "height_m": 1, "vclass": "bus"}}}, "types.car.length_m = -1"),
        ({"more": 1}, "invalid metadata: more = 1"),
        (b"{", "its metadata is not valid JSON"),
    ],
)
def test_rejects_file_with_wrong_metadata(city: City, changed: dict | bytes, message: str) -> None:
    traffic_split.make_city_traffic(city)
    path = city.junctions[0].traffic_file(city)
    table = pq.read_table(path)
    metadata = json.loads(pq.read_metadata(path).metadata[b"egvs"])
    raw = changed if isinstance(changed, bytes) else json.dumps(metadata | changed).encode()
    pq.write_table(table.replace_schema_metadata({b"egvs": raw}), path)
    with pytest.raises(InputError) as caught:
        egvs.run(egvs.load(city.junctions[0].scenario_folder(city)), city.folder / "run", jobs=1)
    assert message in str(caught.value) and path.name in str(caught.value)


NODES = """<nodes>
  <node id="a" x="-180" y="0"/><node id="W" x="20" y="0" type="traffic_light"/>
  <node id="E" x="520" y="0" type="traffic_light"/><node id="b" x="900" y="0"/><node id="s" x="520" y="-300"/>
</nodes>"""
EDGES = """<edges>
  <edge id="in" from="a" to="W"/><edge id="middle" from="W" to="E"/><edge id="out" from="E" to="b"/>
  <edge id="side" from="s" to="E"/>
</edges>"""
SIMULATED = """\
network = "net.net.xml"
counts = [
    { from_edge = "in", to_edge = "middle", per_hour = 200 },
    { from_edge = "side", to_edge = "out", per_hour = 200 },
]
step_s = 0.5
warmup_s = 60
frames = 3000"""


def simulate_city(city: City, red: tuple[str, ...]) -> City:
    """Give the city a network of its two junctions, at some of which the signals stay red for good."""
    folder = city.folder
    (folder / "n.nod.xml").write_text(NODES)
    (folder / "e.edg.xml").write_text(EDGES)
    sumo.run_program("netconvert", ["-n", "n.nod.xml", "-e", "e.edg.xml", "--offset.disable-normalization", "-o",
                                    "net.net.xml"], folder)  # fmt: skip
    network = ET.parse(folder / "net.net.xml")
    for program in network.iter("tlLogic"):
        for phase in program.iter("phase"):
            letter = "r" if program.get("id") in red else "G"
            phase.set("state", letter * len(phase.get("state", "")))
    network.write(folder / "net.net.xml")
    edit(folder / "city.toml", SIMULATED, 'fcd = "fcd.csv"\nframes = 60')
    return load_city(folder)


@pytest.mark.slow
def test_junction_that_locks_is_left_out_while_sumo_runs(city: City) -> None:
    made = traffic_split.make_city_traffic(simulate_city(city, ("W",)))
    assert list(made.left_out) == ["west"]
    assert re.match(
        r"its traffic is locked: vehicle '.*' stood at junction W, edge in .* from \d+ s to \d+ s",
        made.left_out["west"],
    )
    assert made.rows["east"] > 0
    assert made.summary["sumo_peak_mb"] > 10
    assert not city.junction("west").traffic_file(city).exists()


@pytest.mark.slow
def test_sumo_is_stopped_when_all_junctions_are_locked(city: City) -> None:
    locked = simulate_city(city, ("W", "E"))
    with pytest.raises(
        RunError, match=r"traffic\.counts: the traffic in all 2 regions of interest is locked: "
    ) as caught:
        traffic_split.make_city_traffic(locked)
    assert "Lower per_hour of the counts" in str(caught.value)
    assert not list((city.folder / "traffic").glob("*.parquet"))
    assert not (city.folder / "traffic" / traffic_split.RECORD_FILE).exists()
