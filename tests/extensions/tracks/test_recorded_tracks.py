"""Recorded tracks as traffic: the same boxes as a finished FCD file of the same vehicles, and clear messages."""

from __future__ import annotations

import csv
import gzip
import math
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.run_record import RunRecord
from egvs.artefacts.tpog import read_tpog
from egvs.core.errors import InputError
from egvs.extensions.tracks import recorded_tracks
from egvs.extensions.tracks.sources import TrackSource
from egvs.formats.georeference import Georeference, WorldFrame
from egvs.stages import check
from tests.conftest import SCENARIO, collection, fcd, feature
from tests.traffic.helpers import netgenerate
from tests.traffic.test_road_lanes import edge

HALF_CAR_M = 2.25

TRACKS = 'tracks = ["tracks.csv"]'


def boxes_of_fcd() -> list[tuple[str, float, float, float, float]]:
    """Return (vehicle, time_s, x_m, y_m, yaw_rad) of the boxes in the finished file of the small scenario."""
    rows = []
    for row in csv.DictReader(fcd().splitlines(), delimiter=";"):
        yaw_rad = math.radians(90.0 - float(row["vehicle_angle"]))
        x_m = float(row["vehicle_x"]) - HALF_CAR_M * math.cos(yaw_rad)
        y_m = float(row["vehicle_y"]) - HALF_CAR_M * math.sin(yaw_rad)
        rows.append((row["vehicle_id"], float(row["timestep_time"]), x_m, y_m, yaw_rad))
    return rows


def interaction_csv(rows: list[tuple[str, float, float, float, float]], start_s: float = 0.0) -> str:
    """Return tracks in INTERACTION's columns; sizes are those of the scenario's cars."""
    lines = ["track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,psi_rad,length,width"]
    for name, time_s, x_m, y_m, yaw_rad in rows:
        time_ms = 1000 * (start_s + time_s)
        lines.append(f"{name},0,{time_ms:.3f},car,{x_m:.9f},{y_m:.9f},0,0,{yaw_rad:.12f},4.5,1.8")
    return "\n".join(lines) + "\n"


def use_tracks(folder: Path, text: str, keys: str = "") -> None:
    (folder / "tracks.csv").write_text(text)
    scenario = SCENARIO.replace('fcd = "fcd.csv"', f'{TRACKS}\ntrack_crs = "world"\n{keys}')
    (folder / "scenario.toml").write_text(scenario)


def make_tpog(run_egvs, folder: Path, out: Path) -> None:
    for stage in ("traffic", "statics", "tpog"):
        assert run_egvs(stage, folder, "--out", out)[0] == 0


@pytest.mark.slow
def test_tracks_give_the_same_trajectories_and_tpog_as_fcd(mini: Path, run_egvs, tmp_path: Path) -> None:
    """Positions agree to a micrometre, all counts of the TPOG exactly."""
    make_tpog(run_egvs, mini, tmp_path / "fcd")
    use_tracks(mini, interaction_csv(boxes_of_fcd()))
    make_tpog(run_egvs, mini, tmp_path / "tracks")
    expected, actual = (pq.read_table(tmp_path / name / "trajectories.parquet") for name in ("fcd", "tracks"))
    assert actual.schema.names == expected.schema.names
    for name in expected.schema.names:
        if expected[name].type in ("double",):
            np.testing.assert_allclose(actual[name].to_numpy(), expected[name].to_numpy(), atol=2e-6)
        else:
            assert actual[name].to_pylist() == expected[name].to_pylist()
    np.testing.assert_array_equal(
        read_tpog(tmp_path / "tracks" / "tpog.parquet").counts, read_tpog(tmp_path / "fcd" / "tpog.parquet").counts
    )


@pytest.mark.slow
def test_clock_of_the_recording_does_not_matter(mini: Path, run_egvs, tmp_path: Path) -> None:
    for start_s in (0.0, 1.6e9):
        use_tracks(mini, interaction_csv(boxes_of_fcd(), start_s))
        make_tpog(run_egvs, mini, tmp_path / f"{start_s}")
    counts = [read_tpog(tmp_path / f"{start_s}" / "tpog.parquet").counts for start_s in (0.0, 1.6e9)]
    np.testing.assert_array_equal(*counts)


def test_all_frames_of_the_recording_are_used(mini: Path) -> None:
    use_tracks(mini, interaction_csv(boxes_of_fcd()))
    text = (mini / "scenario.toml").read_text().replace("frames = 40\n", "")
    (mini / "scenario.toml").write_text(text)
    window = recorded_tracks.tracks_window(egvs.load(mini))
    assert (window.count, window.period_ms) == (40, 500)


def test_wrong_time_does_not_make_billions_of_frames(mini: Path) -> None:
    use_tracks(mini, interaction_csv([*boxes_of_fcd(), ("b", 4e9, 1.0, 1.0, 0.0)]))
    text = (mini / "scenario.toml").read_text().replace("frames = 40\n", "")
    (mini / "scenario.toml").write_text(text)
    with pytest.raises(InputError, match="more than 5,000,000 frames"):
        recorded_tracks.tracks_window(egvs.load(mini))


def test_times_in_another_unit_are_named(mini: Path) -> None:
    """Without traffic.frames, all of 0.019 s would be used, which do not fill the blocks."""
    use_tracks(mini, interaction_csv([(name, time_s / 1000, *rest) for name, time_s, *rest in boxes_of_fcd()]))
    text = (mini / "scenario.toml").read_text()
    (mini / "scenario.toml").write_text(re.sub(r"(?m)^frames = .*\n", "", text))
    with pytest.raises(
        InputError, match=r"1 frame; expected at least 4 \(tpog\.blocks\)\. Check the unit of the times"
    ):
        recorded_tracks.tracks_window(egvs.load(mini))


def test_two_files_are_on_one_clock(mini: Path, run_egvs, tmp_path: Path) -> None:
    """The vehicles of one file in two files: the same frames; names that occur twice get the number of their file."""
    rows = boxes_of_fcd()
    use_tracks(mini, interaction_csv([row for row in rows if row[0] == "east"]))
    (mini / "more.csv").write_text(interaction_csv([("east", *row[1:]) for row in rows if row[0] == "west"]))
    text = (mini / "scenario.toml").read_text().replace(TRACKS, 'tracks = ["tracks.csv", "more.csv"]')
    (mini / "scenario.toml").write_text(text)
    assert run_egvs("traffic", mini, "--out", tmp_path / "run")[0] == 0
    table = pq.read_table(tmp_path / "run" / "trajectories.parquet")
    assert set(table["vehicle"].to_pylist()) == {"0: east", "1: east"}
    assert table.num_rows == 80


def test_people_do_not_count_as_vehicles(mini: Path, run_egvs, tmp_path: Path) -> None:
    text = interaction_csv(boxes_of_fcd()).replace("east,0,", "P1,0,").splitlines()
    lines = [line.replace("car", "pedestrian") if line.startswith("P1") else line for line in text]
    use_tracks(mini, "\n".join(lines) + "\n")
    assert run_egvs("traffic", mini, "--out", tmp_path / "run")[0] == 0
    summary = RunRecord.read(tmp_path / "run").stages["traffic"].summary
    assert summary["vehicles"]["most"] == 1
    assert summary["beside_vehicles"]["pedestrian"]["different"] == 1


def test_recording_of_pedestrians_only(mini: Path, run_egvs, tmp_path: Path) -> None:
    use_tracks(mini, interaction_csv(boxes_of_fcd()).replace(",car,", ",pedestrian,"))
    make_tpog(run_egvs, mini, tmp_path / "run")
    assert read_tpog(tmp_path / "run" / "tpog.parquet").counts.any()
    assert RunRecord.read(tmp_path / "run").stages["tpog"].summary["with_people"]


def test_drops_boxes_outside_coverage(mini: Path, run_egvs, tmp_path: Path) -> None:
    """The western half of the region, where x < 20 m."""
    use_tracks(mini, interaction_csv(boxes_of_fcd()), 'coverage = "coverage.geojson"\n')
    ring = [[-50, -20], [20, -20], [20, 20], [-50, 20], [-50, -20]]
    (mini / "coverage.geojson").write_text(collection(feature({"type": "Polygon", "coordinates": [ring]})))
    assert run_egvs("traffic", mini, "--out", tmp_path / "run")[0] == 0
    x_m = pq.read_table(tmp_path / "run" / "trajectories.parquet")["x_m"].to_numpy()
    assert x_m.size and x_m.max() <= 20.0
    summary = RunRecord.read(tmp_path / "run").stages["traffic"].summary["tracks"]
    assert summary["outside_coverage"] == sum(row[2] > 20.0 for row in boxes_of_fcd())
    assert summary["coverage"] == {"source": "given", "share": 0.5, "of": "area of the region of interest"}


def test_kind_of_the_scenario_sets_missing_size(mini: Path, run_egvs, tmp_path: Path) -> None:
    """The recording has no heights: the scenario's kind "car" is 1.5 m high, as the class; then it is made 2 m."""
    use_tracks(mini, interaction_csv(boxes_of_fcd()))
    assert (
        run_egvs(
            "traffic",
            mini,
            "--out",
            tmp_path / "run",
            "--set",
            "traffic.kinds=[{name='car',length_m=4,width_m=2,height_m=2.0}]",
        )[0]
        == 0
    )
    table = pq.read_table(tmp_path / "run" / "trajectories.parquet")
    assert set(table["height_m"].to_pylist()) == {2.0}
    assert set(table["length_m"].to_pylist()) == {4.5}


def test_position_and_heading_are_converted_from_another_grid(tmp_path: Path) -> None:
    """At 9 degrees east, UTM 33 is turned by 4.6 degrees against UTM 32."""
    frame = WorldFrame("EPSG:32632", (-500_000.0, -5_600_000.0))
    east_m, north_m = frame.to_crs(np.array([[0.0, 0.0], [10.0, 0.0]]), "EPSG:32633")
    yaw_rad = math.atan2(north_m[1] - east_m[1], north_m[0] - east_m[0])
    path = tmp_path / "tracks.csv"
    path.write_text(interaction_csv([("a", 0.0, *east_m, yaw_rad), ("a", 1.0, *north_m, yaw_rad)]))
    world = Georeference(frame, egvs.core.grid.Roi((-50.0, -50.0, 0.0), (100.0, 100.0, 5.0)), "scenario.toml")
    tracks = recorded_tracks.read_in_world_frame(TrackSource((path,), crs="EPSG:32633"), world)
    assert abs(math.degrees(yaw_rad)) > 4.0
    np.testing.assert_allclose(tracks.x_m, [0.0, 10.0], atol=1e-4)
    np.testing.assert_allclose(tracks.y_m, [0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(tracks.yaw_rad, 0.0, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda folder: (folder / "tracks.csv").unlink(), "tracks.csv"),
        (lambda folder: (folder / "tracks.csv").write_text("a,b\n1,2\n"), "the format of the tracks is unknown. "),
        (
            lambda folder: (folder / "tracks.csv").write_text("track_id,timestamp_ms,y,agent_type\n1,2,3,car\n"),
            "is unknown; nearest to INTERACTION or TAF-BW tracks, without x. ",
        ),
        (
            lambda folder: (folder / "tracks.csv").write_text("Track_ID,timestamp_ms,y,x\n1,2,3,4\n"),
            "is unknown; nearest to INTERACTION or TAF-BW tracks, without agent_type. ",
        ),
        (lambda folder: (folder / "tracks.csv").write_text(interaction_csv([]).strip()), "contains no rows"),
        (
            lambda folder: (folder / "tracks.csv").write_text(interaction_csv([("a", 0.0, 1.0, math.nan, 0.0)])),
            "line 2: y: expected a number, got 'nan'",
        ),
        (
            lambda folder: (folder / "tracks.csv").write_text(interaction_csv([("a", 0.0, 1.0, 1.0, 0.0)])),
            "last 0 s, 1 frame",
        ),
        (
            lambda folder: (folder / "tracks.csv").write_text(
                interaction_csv([(name, time_s / 1000, *rest) for name, time_s, *rest in boxes_of_fcd()])
            ),
            "last 0.019 s, 1 frame after 0 s. Check the unit of the times: seconds in a column of milliseconds",
        ),
        (
            lambda folder: (folder / "tracks.csv").write_text(
                interaction_csv([(name, time_s, x_m + 4e5, 0.0, 0.0) for name, time_s, x_m, *_ in boxes_of_fcd()])
            ),
            "from the region of interest",
        ),
        (
            lambda folder: (folder / "tracks.csv").write_bytes(
                gzip.compress(interaction_csv(boxes_of_fcd()).encode())[:-20]
            ),
            "tracks.csv",
        ),
    ],
    ids=[
        "missing",
        "unknown format",
        "without x",
        "without agent_type",
        "no rows",
        "NaN",
        "too short",
        "seconds",
        "far away",
        "truncated",
    ],
)
def test_wrong_tracks_are_reported(mini: Path, run_egvs, tmp_path: Path, change, message: str) -> None:
    use_tracks(mini, interaction_csv(boxes_of_fcd()))
    change(mini)
    code, _, err = run_egvs("run", mini, "--out", tmp_path / "run")
    assert code == 2
    assert message in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('network = "net.xml"\n', "expected exactly one of network, sumocfg, fcd and tracks"),
        ("track_gap_s = 0\n", "track_gap_s"),
    ],
)
def test_contradicting_keys(mini: Path, run_egvs, tmp_path: Path, keys: str, message: str) -> None:
    use_tracks(mini, interaction_csv(boxes_of_fcd()), keys)
    code, _, err = run_egvs("run", mini, "--out", tmp_path / "run")
    assert code == 2
    assert message in err


def test_warns_of_a_cut_track(mini: Path, run_egvs, tmp_path: Path) -> None:
    rows = [
        (name, time_s, x_m + (200.0 if time_s > 10 and name == "east" else 0.0), *more)
        for name, time_s, x_m, *more in boxes_of_fcd()
    ]
    use_tracks(mini, interaction_csv(rows))
    assert run_egvs("traffic", mini, "--out", tmp_path / "run")[0] == 0
    rules = [warning["rule"] for warning in RunRecord.read(tmp_path / "run").stages["traffic"].summary["warnings"]]
    assert "track jumps" in rules


COLUMNS = """
[traffic.track_columns]
time = "t"
id = "who"
x = "east"
y = "north"
yaw = "heading"
yaw_unit = "deg"
yaw_convention = "cw_from_north"
length = "l"
width = "w"
default_type = "car"
"""


@pytest.mark.slow
def test_own_table_gives_the_same_tpog(mini: Path, run_egvs, tmp_path: Path) -> None:
    """The same boxes with other names of columns, and headings clockwise from north in degrees."""
    use_tracks(mini, interaction_csv(boxes_of_fcd()))
    make_tpog(run_egvs, mini, tmp_path / "interaction")
    lines = ["t,who,east,north,heading,l,w"]
    for name, time_s, x_m, y_m, yaw_rad in boxes_of_fcd():
        lines.append(f"{time_s},{name},{x_m:.9f},{y_m:.9f},{90.0 - math.degrees(yaw_rad):.9f},4.5,1.8")
    use_tracks(mini, "\n".join(lines) + "\n")
    text = (mini / "scenario.toml").read_text().replace("[[traffic.kinds]]", f"{COLUMNS}\n[[traffic.kinds]]")
    (mini / "scenario.toml").write_text(text)
    make_tpog(run_egvs, mini, tmp_path / "own")
    counts = [read_tpog(tmp_path / name / "tpog.parquet").counts for name in ("interaction", "own")]
    np.testing.assert_array_equal(*counts)


@pytest.mark.slow
def test_long_gap_is_unknown_and_not_empty(mini: Path, run_egvs, tmp_path: Path) -> None:
    """Without the rows of one car between 6 and 10 s (frames 12 to 20), voxels on its way there are scaled."""
    rows = [row for row in boxes_of_fcd() if not (row[0] == "east" and 6.0 <= row[1] <= 10.0)]
    use_tracks(mini, interaction_csv(rows))
    make_tpog(run_egvs, mini, tmp_path / "run")
    (gap,) = parquet.read_metadata(tmp_path / "run" / "trajectories.parquet", "trajectories")["unknown_boxes"]
    assert gap["frames"] == [12, 21]
    assert gap["size_m"] == [4.5, 1.8]
    np.testing.assert_allclose([*gap["start_m"], *gap["end_m"]], [5.5 * 2 + 1 - 2.25, -2, 10.5 * 2 + 1 - 2.25, -2])
    stages = RunRecord.read(tmp_path / "run").stages
    assert stages["traffic"].summary["tracks"]["unknown_frames"] == 9
    assert stages["tpog"].summary["unknown_gaps"] == 1
    assert stages["tpog"].summary["scaled_voxels"] + stages["tpog"].summary["unknown_voxels"] > 0


@pytest.mark.slow
def test_short_gap_is_interpolated(mini: Path, run_egvs, tmp_path: Path) -> None:
    """Cars on a straight line: without two rows of one car, the trajectories are the same."""
    use_tracks(mini, interaction_csv(boxes_of_fcd()))
    make_tpog(run_egvs, mini, tmp_path / "complete")
    rows = [row for row in boxes_of_fcd() if not (row[0] == "east" and row[1] in (6.0, 6.5))]
    use_tracks(mini, interaction_csv(rows))
    make_tpog(run_egvs, mini, tmp_path / "gap")
    counts = [read_tpog(tmp_path / name / "tpog.parquet").counts for name in ("complete", "gap")]
    np.testing.assert_array_equal(*counts)
    assert RunRecord.read(tmp_path / "gap").stages["traffic"].summary["tracks"]["interpolated_gaps"] == 1


def walkers(seconds: int) -> str:
    """Return a pedestrian who walks along the road, and a car, which does not count."""
    rows = [("walker", 1.0 * k, 1.2 * k, 9.0, 0.0) for k in range(seconds)]
    text = interaction_csv(rows).replace(",car,", ",pedestrian,")
    return text + "\n".join(interaction_csv([("driver", 0.0, 0.0, 0.0, 0.0)]).splitlines()[1:]) + "\n"


def simulated(folder: Path, text: str) -> None:
    """Write a scenario with simulated cars on two streets that cross, and recorded pedestrians."""
    netgenerate(folder, "--grid", "--grid.number", "1", "--grid.length", "60", "--grid.attach-length", "60")
    (folder / "people.csv").write_text(text)
    source = 'network = "net.xml"\npedestrian_tracks = ["people.csv"]\ntrack_crs = "world"'
    scenario = SCENARIO.replace('fcd = "fcd.csv"', source).replace("warmup_s = 0", "warmup_s = 30")
    scenario = scenario.replace("frame_period_s = 0.5", "frame_period_s = 1.0\nvehicles = 3")
    (folder / "scenario.toml").write_text(scenario.replace("center_m = [20, 0, 2.5]", "center_m = [60, 60, 2.5]"))


@pytest.mark.slow
def test_recorded_pedestrians_walk_beside_simulated_vehicles(mini: Path, run_egvs, tmp_path: Path) -> None:
    """At frame k the pedestrian is at x = 1.2 k: the warm-up of the simulation shifts nothing."""
    simulated(mini, walkers(41))
    assert run_egvs("traffic", mini, "--out", tmp_path / "run")[0] == 0
    table = pq.read_table(tmp_path / "run" / "trajectories.parquet").to_pandas()
    people = table[table["kind"] == "pedestrian"]
    assert set(people["vehicle"]) == {"walker"}
    np.testing.assert_allclose(people["x_m"], 1.2 * people["frame"], atol=1e-5)
    assert set(table[table["kind"] != "pedestrian"].groupby("frame").size()) == {3}
    summary = RunRecord.read(tmp_path / "run").stages["traffic"].summary
    assert summary["beside_vehicles"]["pedestrian"]["different"] == 1
    assert summary["tracks"]["classes"] == {"pedestrian": 1}
    assert "recorded pedestrians" in [warning["rule"] for warning in summary["warnings"]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (walkers(20), "people.csv last 19 s, 20 frames"),
        (interaction_csv(boxes_of_fcd()), "contains nobody on foot or on a bicycle"),
    ],
    ids=["too short", "cars only"],
)
def test_wrong_pedestrian_tracks_are_reported(mini: Path, run_egvs, tmp_path: Path, text: str, message: str) -> None:
    simulated(mini, text)
    code, _, err = run_egvs("run", mini, "--out", tmp_path / "run")
    assert code == 2
    assert message in err


@pytest.mark.slow
def test_recorded_and_simulated_pedestrians_exclude_each_other(mini: Path, run_egvs, tmp_path: Path) -> None:
    simulated(mini, walkers(41))
    options = ("--set", "effects.pedestrians_bicycles.pedestrians_per_h=10")
    code, _, err = run_egvs("traffic", mini, "--out", tmp_path / "run", *options)
    assert code == 2
    assert "pedestrians are recorded, and an effect simulates others" in err


SLOPING = """<net version="1.20">
    <edge id="up" from="a" to="b"><lane id="up_0" index="0" speed="9" length="100" shape="-50,-2,0 50,-2,10"/></edge>
    <edge id="down" from="b" to="a"><lane id="down_0" index="0" speed="9" length="100" shape="50,2,10 -50,2,0"/></edge>
    <junction id="a" type="dead_end" x="-50" y="0" z="0" incLanes="down_0" intLanes="" shape="-50,-4,0 -50,4,0"/>
    <junction id="b" type="dead_end" x="50" y="0" z="10" incLanes="up_0" intLanes="" shape="50,4,10 50,-4,10"/>
</net>
"""


def test_tracks_stand_on_a_sloping_road(mini: Path, run_egvs, tmp_path: Path) -> None:
    """The road rises by a tenth: at x = 20 m it is at z = 7 m. A box of 4.5 m is pitched by 5.7 degrees."""
    rows = [row for row in boxes_of_fcd() if row[0] == "east"]
    use_tracks(mini, interaction_csv(rows), 'roads = "roads.net.xml"\n')
    (mini / "roads.net.xml").write_text(SLOPING)
    assert run_egvs("traffic", mini, "--out", tmp_path / "run")[0] == 0
    table = pq.read_table(tmp_path / "run" / "trajectories.parquet")
    np.testing.assert_allclose(table["pitch_rad"].to_numpy(), math.atan(0.1), atol=2e-3)
    centre_m = 5.0 + 0.1 * table["x_m"].to_numpy() + 0.75 * math.cos(math.atan(0.1))
    np.testing.assert_allclose(table["z_m"].to_numpy(), centre_m, atol=0.05)


def test_solids_of_another_zero_than_tracks_are_an_error(mini: Path, run_egvs) -> None:
    """Without a network, tracks are at z = 0; solids and sensors above sea level are nowhere near them."""
    use_tracks(mini, interaction_csv(boxes_of_fcd()))
    assert "heights" not in run_egvs("check", mini)[1]
    ring = [[14, 5], [18, 5], [18, 8], [14, 8], [14, 5]]
    house = feature({"type": "Polygon", "coordinates": [ring]}, name="house", height_m=118, base_m=112)
    (mini / "statics.geojson").write_text(collection(house))
    code, out, _ = run_egvs("check", mini)
    assert code == 2
    assert "1 of 1 solid near the region has its foot 112.0 m above the traffic beside it: house" in out


def drives(folder: Path, rows: list[tuple[str, float, float, float, float]], roads: str) -> None:
    """Use rows (vehicle, time_s, x_m, y_m, yaw_rad) of tracks on a network."""
    use_tracks(folder, interaction_csv(rows), 'roads = "made.net.xml"\n')
    (folder / "made.net.xml").write_text(f'<net version="1.20">{roads}</net>')


def along(name: str, y_m: float, yaw_rad: float = 0.0, start_m: float = -10.0) -> list:
    """A vehicle that drives 60 m along +x in 20 s."""
    return [(name, 0.5 * step, start_m + 1.5 * step, y_m, yaw_rad) for step in range(41)]


def error_rules(folder: Path) -> dict[str, str]:
    return {error.rule: error.problem for error in check.check_scenario(egvs.load(folder)).errors}


def test_tracks_that_fit_the_road_have_no_error(mini: Path) -> None:
    drives(mini, along("a", 0.0), edge("e", "-50,0 100,0"))
    assert error_rules(mini) == {}


@pytest.mark.parametrize(
    ("rows", "rule"),
    [
        (along("a", -7.0), "vehicles off their lanes"),
        (along("a", 0.0, yaw_rad=math.pi / 2.0), "headings"),
        (
            [(name, 20.0 - time_s, *rest, math.pi) for name, time_s, *rest, _ in along("a", 0.0)],
            "vehicles against lanes",
        ),
        ([*along("a", 0.0), *along("a", 0.0, start_m=5.0)], "shared names"),
    ],
)
def test_tracks_that_fit_no_road_are_rejected(mini: Path, rows: list, rule: str) -> None:
    """Each by the same rule as an FCD file."""
    drives(mini, rows, edge("e", "-50,0 100,0"))
    assert list(error_rules(mini)) == [rule]


def test_rows_of_a_second_vehicle_are_counted(mini: Path) -> None:
    """Of 82 rows, 41 are of another vehicle with the same name; equal rows say nothing about a second one."""
    drives(mini, [*along("a", 0.0), *along("a", 0.0, start_m=5.0)], edge("e", "-50,0 100,0"))
    assert error_rules(mini)["shared names"].startswith(
        "expected one row for each vehicle and time, got 41 others in 82 rows, in other places ('a' at 0 s)"
    )
    drives(mini, [*along("a", 0.0), *along("a", 0.0)], edge("e", "-50,0 100,0"))
    assert error_rules(mini) == {}


def test_tracks_below_a_bridge_stay_on_the_lower_road(mini: Path, run_egvs, tmp_path: Path) -> None:
    """In the middle of the crossing, the lane of the bridge is the nearest in plan, 6 m above."""
    drives(mini, along("a", 1.0), edge("e", "-50,0 100,0") + edge("bridge", "20,-50,6 20,50,6"))
    assert run_egvs("traffic", mini, "--out", tmp_path / "run")[0] == 0
    table = pq.read_table(tmp_path / "run" / "trajectories.parquet")
    np.testing.assert_allclose(table["z_m"].to_numpy(), table["height_m"].to_numpy() / 2.0)
