"""A city's traffic is recorded once and cut: a junction gets the same as from the whole, and nothing is half made."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.city import traffic_split
from egvs.city.model import City, load_city
from egvs.core.errors import InputError, RunError
from egvs.traffic import fcd
from tests.checks.conftest import net_xml
from tests.city.conftest import FRAMES

pytestmark = pytest.mark.system
ARTICULATED = "\n[effects.articulated]\nkinds = { bus = { parts_m = [9.0, 8.0] } }\n"


def add(path: Path, text: str, old: str = "") -> None:
    """Change a file: ``text`` instead of ``old``, or at its end."""
    was = path.read_text()
    assert old in was
    path.write_text(was.replace(old, text) if old else was + text)


def contents(city: City) -> dict[str, bytes]:
    """What lies in the folder of the traffic; the seal without what a clock says."""
    return {path.name: path.read_bytes() for path in (city.folder / "traffic").glob("*.parquet")}


def uncut(city: City, name: str, monkeypatch: pytest.MonkeyPatch) -> bytes:
    """The junction's traffic with every vehicle of the city."""
    wide = traffic_split.find_traffic_regions(city)
    wide[name] = replace(wide[name], low_x_m=-1e4, low_y_m=-1e4, high_x_m=1e4, high_y_m=1e4)
    with monkeypatch.context() as patch:
        patch.setattr(traffic_split, "find_traffic_regions", lambda *_: wide)
        assert traffic_split.make_city_traffic(city).rows[name] == 3 * FRAMES
    return city.junction(name).traffic_file(city).read_bytes()


@pytest.mark.slow
def test_each_junction_gets_every_frame_with_vehicles_or_without(city: City) -> None:
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
def test_a_junction_alone_gets_what_it_gets_from_all_vehicles(
    city: City, effects: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The boxes in the region, the TPOG and the scores, to the last bit; the bus bends as its whole way bent it."""
    folder = city.junctions[0].scenario_folder(city)
    add(folder / "scenario.toml", effects + '\n[score]\nrank_by = "expected_detections"\n', "\n[score]\n")
    whole = uncut(city, "west", monkeypatch)
    runs = {}
    for way in ("whole", "cut"):
        if way == "cut":
            (city.folder / "traffic" / traffic_split.SEAL_FILE).unlink()
            assert traffic_split.make_city_traffic(city).is_new
            assert city.junctions[0].traffic_file(city).read_bytes() != whole
        egvs.run(egvs.load(folder), city.folder / way, jobs=1)
        runs[way] = city.folder / way
    boxes = {way: near(egvs.read_trajectories(run / "trajectories.parquet")) for way, run in runs.items()}
    assert boxes["cut"].num_rows > 60 and boxes["cut"].equals(boxes["whole"])
    if effects:
        assert boxes["cut"]["part"].to_numpy().max() == 1
    for artefact in ("tpog", "scores", "scans", "blindspots"):
        ours, its = (parquet.read_artefact(runs[way] / f"{artefact}.parquet", artefact) for way in ("cut", "whole"))
        assert ours[0].num_rows and ours[0].to_pandas().equals(its[0].to_pandas()), artefact  # NaN is NaN
        for about in (ours[1], its[1]):
            del about["inputs"]  # the files' hashes
        assert ours[1] == its[1]


def near(boxes: pa.Table) -> pa.Table:
    """Those within 60 m of the western region, where there are more of the whole."""
    x, y = boxes["x_m"].to_numpy(), boxes["y_m"].to_numpy()
    return boxes.filter(pa.array((np.abs(x - 20) < 80) & (np.abs(y) < 70))).combine_chunks()


def test_every_box_that_may_lie_in_a_region_is_kept(city: City) -> None:
    """Against the corners of 4000 random boxes."""
    draw = np.random.default_rng(5)
    n = 4000
    x, y, angle = draw.uniform(-400, 400, n), draw.uniform(-400, 400, n), np.radians(draw.uniform(0, 360, n))
    length, width = draw.uniform(0.5, 30, n), draw.uniform(0.5, 4, n)
    kept = traffic_split._may_reach(traffic_split.find_traffic_regions(city)["west"], x, y, np.hypot(length, width))
    low_x, low_y, high_x, high_y = traffic_split.find_traffic_regions(city)["west"].to_json()
    assert (low_x, low_y, high_x, high_y) == (-60.0, -80.0, 100.0, 80.0)
    meets = np.zeros(n, dtype=bool)
    for along in np.linspace(0, 1, 61):
        for across in np.linspace(-0.5, 0.5, 9):
            px = x - along * length * np.sin(angle) + across * width * np.cos(angle)
            py = y - along * length * np.cos(angle) - across * width * np.sin(angle)
            meets |= (px >= low_x) & (px <= high_x) & (py >= low_y) & (py <= high_y)
    assert meets.sum() > 100 and (~kept).sum() > 1000
    assert not (meets & ~kept).any()


def test_what_is_there_is_not_made_again_and_what_changed_is(city: City) -> None:
    first = traffic_split.make_city_traffic(city)
    assert first.is_new and not traffic_split.make_city_traffic(city).is_new
    before = contents(city)
    assert traffic_split.make_city_traffic(city) == replace(first, is_new=False)
    (city.folder / "traffic" / "east.parquet").write_bytes(b"altered")
    assert traffic_split.make_city_traffic(city).is_new and contents(city) == before
    (city.folder / "traffic" / "west.parquet").unlink()
    assert traffic_split.make_city_traffic(city).is_new and contents(city) == before
    (city.folder / "traffic" / traffic_split.SEAL_FILE).write_text("[]")
    assert traffic_split.make_city_traffic(city).is_new and contents(city) == before
    moved = load_city(city.folder.rename(city.folder.parent / "elsewhere"))
    assert not traffic_split.make_city_traffic(moved).is_new
    moved.folder.rename(city.folder)
    add(city.folder / "junctions" / "west" / "sites.csv", "pole_c,12,12,3\n")  # where the region reaches anyway
    assert not traffic_split.make_city_traffic(city).is_new
    add(city.folder / "junctions" / "west" / "sites.csv", "pole_d,12,60,3\n")
    assert traffic_split.make_city_traffic(city).is_new
    add(city.folder / "city.toml", "frames = 50", "frames = 60")
    assert traffic_split.make_city_traffic(load_city(city.folder)).frames == 50


def test_nothing_is_half_written_where_it_ends_in_the_middle(city: City, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = {**contents(city), **(traffic_split.make_city_traffic(city) and contents(city))}
    add(city.folder / "city.toml", "seed = 8", "seed = 7")
    again = load_city(city.folder)

    class Killed(BaseException):
        pass

    def killed(_what: str, done: int, _total: int) -> None:
        if done >= 40:
            raise Killed

    with pytest.raises(Killed):
        traffic_split.make_city_traffic(again, killed)
    left = sorted(path.name for path in (city.folder / "traffic").iterdir())
    assert left == [".lock", "east.parquet", "traffic.json", "west.parquet"]  # those of before, with their seal
    assert contents(city) == whole
    assert traffic_split.make_city_traffic(again).is_new
    assert contents(city) == whole  # the seed changes nothing in a finished file


def test_the_files_are_what_sumo_writes(city: City) -> None:
    traffic_split.make_city_traffic(city)
    path = city.folder / "traffic" / "west.parquet"
    plain = pq.read_table(path).replace_schema_metadata()
    rows = {(t, name): (x, y) for t, name, x, y in zip(*(plain[c].to_pylist() for c in plain.column_names[:2]),
            *(plain[c].to_pylist() for c in ("vehicle_x", "vehicle_y")), strict=True)}  # fmt: skip
    lines = (city.folder / "fcd.csv").read_text().splitlines()[1:]
    whole = {(float(t), name): (float(x), float(y)) for t, name, x, y, *_ in (line.split(";") for line in lines)}
    assert rows.items() <= whole.items()
    assert sum(table.num_rows for table in fcd.read_fcd(path)) == len(rows) == 86


@pytest.mark.parametrize(
    ("file", "old", "new", "told"),
    [
        ("junctions/west/scenario.toml", "../../traffic/west.parquet", "mine.parquet",
         'fcd = "../../traffic/west.parquet"'),
        ("junctions/west/scenario.toml", "frame_period_s = 0.5", "periods = 3",
         "scenario.toml: traffic.periods: expected a list, got 3"),
        ("junctions/west/scenario.toml", "frame_period_s = 0.5", "frame_period_s = 0.75",
         "traffic.frame_period_s: 0.75 s, but"),
        ("junctions/east/scenario.toml", "gamma = 4", "gamma = -4", "score.gamma"),
        ("city.toml", "frames = 60", "frames = 61", "city.toml: traffic: frames = 61: fcd.csv has 60 frames"),
        ("city.toml", "[[traffic.kinds]]", '[[traffic.periods]]\nname = "a/b"\n\n[[traffic.kinds]]',
         "city.toml: traffic.periods.0.name: 'a/b'"),
        ("city.toml", "seed = 7", "seed = 7\n[effects.rain]\nrate_mm_h = 20.0\n",
         "city.toml: effects.rain: adds no traffic; in junctions/scenario.toml"),
        ("city.toml", 'name = "bus"', 'name = "coach"', "vehicle type 'bus' of fcd.csv has no known size"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_in_one_message(city: City, file: str, old: str, new: str, told: str) -> None:
    path = city.folder / file
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        traffic_split.make_city_traffic(load_city(city.folder))
    assert told in str(caught.value)
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


def test_each_period_is_recorded_and_cut(city: City) -> None:
    toml, night = city.folder / "city.toml", city.folder / "night.csv"
    its, plain = city.junctions[0].scenario_folder(city) / "scenario.toml", toml.read_text()
    add(its, "[traffic] # the city's\n", "[traffic]\n")
    before = its.read_text()
    night.write_text((city.folder / "fcd.csv").read_text())
    toml.write_text(plain.replace("[[traffic.kinds]]", PERIODS + "\n[[traffic.kinds]]", 1))
    made = traffic_split.make_city_traffic(load_city(city.folder))
    assert made.is_new and made.linked == ("west", "east") and made.frames == FRAMES + 40
    assert made.rows["west"] == sum(
        pq.read_metadata(city.folder / "traffic" / "periods" / name / "west.parquet").num_rows
        for name in ("day", "night")
    )
    assert (
        "[traffic] # the city's" in its.read_text()
        and 'fcd = "../../traffic/periods/day/west.parquet"' in its.read_text()
    )
    record = egvs.run(egvs.load(its.parent), city.folder / "run", jobs=1)
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
    assert its.read_text().replace("\n\n", "\n") == reordered(before)
    assert (city.folder / "traffic" / "west.parquet").is_file()


def reordered(text: str) -> str:
    """The scenario as it was, with ``fcd`` behind the other keys of its table, and no empty lines."""
    fcd_line = next(line for line in text.splitlines() if line.startswith("fcd = "))
    text = text.replace(f"{fcd_line}\n", "").replace("frame_period_s = 0.5\n", f"frame_period_s = 0.5\n{fcd_line}\n")
    return text.replace("\n\n", "\n")


def test_what_a_set_asks_for_is_recorded(city: City) -> None:
    traffic_split.make_city_traffic(city)
    assert not traffic_split.make_city_traffic(city, sets=["effects.rain.rate_mm_h=20", "score.gamma=3"]).is_new
    assert traffic_split.make_city_traffic(city, sets=["roi.center_m=[20, 100, 2.5]", "roi.size_m=[40, 300, 5]"]).is_new
    assert (
        traffic_split.make_city_traffic(city, sets=["effects.articulated.kinds={bus={parts_m=[9.0, 8.0]}}"]).rows[
            "east"
        ]
        == FRAMES + 7
    )


def test_a_scenario_of_other_traffic_is_left_as_it_is(city: City) -> None:
    path = city.junctions[0].scenario_folder(city) / "scenario.toml"
    add(path, 'fcd = "mine.csv"', 'fcd = "../../traffic/west.parquet"')
    text = path.read_text()
    with pytest.raises(InputError, match=r"comes from mine\.csv, not from the city's"):
        traffic_split.make_city_traffic(city)
    assert path.read_text() == text


def test_junctions_that_do_not_know_the_relief_are_told(city: City) -> None:
    """A network with heights, which the eastern junction names as its roads."""
    hill = net_xml().replace("-40,-1.60 80,-1.60", "-40,-1.60,0 580,-1.60,9")
    (city.folder / "net.net.xml").write_text(hill)
    add(city.folder / "city.toml", 'roads = "net.net.xml"\nfcd =', "fcd =")
    add(city.junctions[1].scenario_folder(city) / "scenario.toml", 'roads = "../../net.net.xml"\nfcd =', "fcd =")
    warnings = traffic_split.make_city_traffic(load_city(city.folder)).summary["warnings"]
    told = [warning["problem"] for warning in warnings if warning["rule"] == "relief"]
    assert told == ["the network goes up and down, but west name no roads: the ground is level there"]


def test_two_processes_do_not_make_it_at_once(city: City) -> None:
    def another(_what: str, _done: int, _total: int) -> None:
        with pytest.raises(RunError, match="another run is at work there"):
            traffic_split.make_city_traffic(city)

    assert traffic_split.make_city_traffic(city, another).is_new


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"frames": 0}, "its metadata says frames = 0"),
        ({"types": {"car": {"length_m": -1, "width_m": 1, "height_m": 1, "vclass": "bus"}}}, "types.car.length_m = -1"),
        ({"more": 1}, "its metadata says more = 1"),
        (b"{", "its metadata is no JSON"),
    ],
)
def test_a_file_that_says_nonsense_of_itself_is_refused(city: City, changed: dict | bytes, told: str) -> None:
    traffic_split.make_city_traffic(city)
    path = city.junctions[0].traffic_file(city)
    table = pq.read_table(path)
    about = json.loads(pq.read_metadata(path).metadata[b"egvs"])
    raw = changed if isinstance(changed, bytes) else json.dumps(about | changed).encode()
    pq.write_table(table.replace_schema_metadata({b"egvs": raw}), path)
    with pytest.raises(InputError) as caught:
        egvs.run(egvs.load(city.junctions[0].scenario_folder(city)), city.folder / "run", jobs=1)
    assert told in str(caught.value) and path.name in str(caught.value)
