"""New scenarios from a map and recorded tracks."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

import egvs
from egvs.core.errors import InputError
from egvs.creation.new_scenario import NewScenarioOptions, create_scenario
from egvs.extensions.tracks.model import Tracks
from egvs.extensions.tracks.new.files import TrackFiles
from egvs.extensions.tracks.new.traffic import ReplayedVehicles
from egvs.traffic import road_check, sumo_folder, traffic_sources
from egvs.world import geolocation
from tests.creation.small_maps import degrees, street, write_map
from tests.extensions.tracks.boxes import assert_same_boxes, moving_boxes
from tests.extensions.tracks.writers_json import write_dair_v2x, write_tumtraf

K733 = Path(__file__).parents[5] / "shared" / "real" / "karlsruhe_k733"

HEADER = "track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,psi_rad,length,width"


def write_tracks(path: Path, duration_s: float = 10.0, x_m: float = 0.0, y_m: float = 0.0) -> Path:
    """Write a car that drives eastwards at 10 m/s."""
    rows = [f"1,{k},{100 * k},car,{x_m + k:.3f},{y_m:.3f},10,0,0.0,4.5,1.8" for k in range(int(duration_s * 10) + 1)]
    path.write_text("\n".join([HEADER, *rows, ""]), encoding="utf-8")
    return path


def test_copies_companion_files(tmp_path: Path) -> None:
    tracks = write_tracks(tmp_path / "vehicle_tracks_000.csv")
    meta = tmp_path / "meta_data.csv"
    meta.write_text("id,originLat,originLon\n000,49.0,8.4\n")
    files = TrackFiles.find([tracks])
    assert files.source.paths == (tracks,)
    assert files.source.companions() == [meta]
    for name, copy in files.copies().items():
        copy(tmp_path / name)
    assert {path.name for path in (tmp_path / "tracks").iterdir()} == {tracks.name, meta.name}


def test_folder_stands_for_the_tracks_in_it(tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    folder.mkdir()
    paths = [write_tracks(folder / name) for name in ("pedestrian_tracks_000.csv", "vehicle_tracks_000.csv")]
    (folder / "README.md").write_text("read me")
    assert TrackFiles.find([folder]).source.paths == tuple(paths)


def test_sweeps_of_a_folder_are_one_recording(tmp_path: Path) -> None:
    """Reading one of them reads all, so they are not listed again."""
    folder = tmp_path / "sweeps"
    folder.mkdir()
    first = write_tumtraf(folder, moving_boxes(["car"], 5))
    files = TrackFiles.find([folder])
    assert files.source.paths == (first,)
    assert files.traffic_table()["tracks"] == [f"tracks/{first.name}"]
    assert len(files.copies()) == 5


def test_copies_keep_the_folders_of_a_data_set(tmp_path: Path) -> None:
    rows = moving_boxes(["car"], 5)
    label = write_dair_v2x(tmp_path, rows)
    files = TrackFiles.find([label.parent])
    for name, copy in files.copies().items():
        copy(tmp_path / "made" / name)
    (name,) = files.traffic_table()["tracks"]
    assert name == "tracks/label/virtuallidar/000000.json"
    assert_same_boxes(TrackFiles.find([tmp_path / "made" / name]).source.read()[0], rows)


def test_rejects_folder_without_tracks(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("read me")
    with pytest.raises(InputError, match="contains no recorded tracks"):
        TrackFiles.find([tmp_path])


def test_rejects_two_files_of_one_name(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    files = TrackFiles.find([write_tracks(tmp_path / name / "tracks.csv") for name in ("a", "b")])
    with pytest.raises(InputError, match="second file of tracks has the same name"):
        files.copies()


@pytest.mark.parametrize(("duration_s", "period_s"), [(60.0, 0.1), (157.0, 0.1), (250.0, 0.25), (3600.0, 1.0)])
def test_frame_period_of_short_recordings_is_short(tmp_path: Path, duration_s: float, period_s: float) -> None:
    files = TrackFiles.find([write_tracks(tmp_path / "tracks.csv", duration_s)])
    assert files.traffic_table()["frame_period_s"] == period_s


def write_crossing(path: Path) -> Path:
    """Write a crossing of two streets at the middle of the made-up map, and another one 300 m to the east."""
    nodes = {1: (-150.0, 0.0), 2: (0.0, 0.0), 3: (300.0, 0.0), 4: (450.0, 0.0)}
    nodes |= {5: (0.0, -150.0), 6: (0.0, 150.0), 7: (300.0, -150.0), 8: (300.0, 150.0)}
    ways = [street("High Street", 1, 2, 3, 4), street("West Street", 5, 2, 6), street("East Street", 7, 3, 8)]
    return write_map(path, nodes, ways)


@pytest.mark.slow
def test_junction_is_that_of_the_tracks(tmp_path: Path) -> None:
    """The car drives from 280 m to 380 m east of the middle, 1.6 m south of the centre line: in its lane."""
    road_map = write_crossing(tmp_path / "map.osm")
    tracks = write_tracks(tmp_path / "vehicle_tracks_000.csv", x_m=250.0, y_m=-1.6)
    lat_deg, lon_deg = degrees((0.0, 0.0))
    (tmp_path / "meta_data.csv").write_text(f"id,originLat,originLon\n000,{lat_deg},{lon_deg}\n")
    new = create_scenario(tmp_path / "new", road_map, options=NewScenarioOptions(tracks=(tracks,)))
    assert "East Street" in new.junction.title
    assert isinstance(new.traffic, ReplayedVehicles)
    assert new.traffic.recorded.alignment is not None
    assert new.traffic.recorded.alignment.share == 1.0
    assert new.flows == ()
    assert egvs.load(tmp_path / "new").traffic.tracks == ("tracks/vehicle_tracks_000.csv",)


@pytest.mark.slow
def test_tracks_in_metres_of_the_map(tmp_path: Path) -> None:
    road_map = write_crossing(tmp_path / "map.osm")
    at_m = create_scenario(tmp_path / "first", road_map).junction.at_m
    tracks = write_tracks(tmp_path / "tracks.csv", x_m=at_m[0] - 50.0, y_m=at_m[1] - 1.6)
    options = NewScenarioOptions(tracks=(tracks,), track_crs="world")
    new = create_scenario(tmp_path / "new", road_map, degrees((0.0, 0.0)), options)
    assert isinstance(new.traffic, ReplayedVehicles)
    assert egvs.load(tmp_path / "new").traffic.track_crs == "world"


@pytest.mark.slow
def test_own_table_of_tracks(run_egvs, tmp_path: Path) -> None:
    road_map = write_crossing(tmp_path / "map.osm")
    at_m = create_scenario(tmp_path / "first", road_map).junction.at_m
    rows = [f"{0.1 * k:.1f};7;{at_m[0] - 50 + k};{at_m[1] - 1.6}" for k in range(101)]
    (tmp_path / "mine.csv").write_text("\n".join(["t;who;east;north", *rows, ""]), encoding="utf-8")
    columns = 'time = "t"\nid = "who"\nx = "east"\ny = "north"\ndelimiter = ";"\ndefault_type = "car"\n'
    (tmp_path / "columns.toml").write_text(columns)
    options = ["--tracks", tmp_path / "mine.csv", "--track-columns", tmp_path / "columns.toml"]
    code, out, err = run_egvs("new", tmp_path / "new", "--from", road_map, *options)
    assert (code, err) == (0, "")
    assert "1 recorded track" in out
    mapping = egvs.load(tmp_path / "new").traffic.track_columns
    assert mapping is not None
    assert (mapping.time, mapping.delimiter) == ("t", ";")


def test_wrong_track_columns_are_reported(run_egvs, tmp_path: Path) -> None:
    road_map, tracks = write_crossing(tmp_path / "map.osm"), write_tracks(tmp_path / "tracks.csv")
    (tmp_path / "columns.toml").write_text('time = "t"\nyax = "x"\n')
    options = ["--tracks", tracks, "--track-columns", tmp_path / "columns.toml"]
    code, _, err = run_egvs("new", tmp_path / "new", "--from", road_map, *options)
    assert code == 2
    assert "columns.toml" in err
    assert not (tmp_path / "new").exists()


PEDESTRIANS = [f"2,{k},{100 * k},pedestrian,{0.1 * k:.3f},5.0,1,0,,," for k in range(101)]


@pytest.mark.slow
def test_tracks_without_vehicles_are_reported(run_egvs, tmp_path: Path) -> None:
    """By a warning when the scenario is made, and as an error before anything is scanned."""
    road_map, new = write_crossing(tmp_path / "map.osm"), tmp_path / "new"
    (tmp_path / "people.csv").write_text("\n".join([HEADER, *PEDESTRIANS, ""]), encoding="utf-8")
    lat_deg, lon_deg = degrees((0.0, 0.0))
    (tmp_path / "meta_data.csv").write_text(f"id,originLat,originLon\n000,{lat_deg},{lon_deg}\n")
    code, out, err = run_egvs("new", new, "--from", road_map, "--tracks", tmp_path / "people.csv")
    told = " ".join((out + err).split())
    assert code == 0 and "the tracks have no vehicle, only classes pedestrian" in told
    code, out, err = run_egvs("check", new)
    told = " ".join((out + err).split())
    assert code == 2 and "--pedestrian-tracks" in told and "[score.weights.kinds]" in told
    code, out, err = run_egvs("check", new, "--set", "score.weights.kinds.pedestrian=1")
    assert "the tracks have no vehicle" not in " ".join((out + err).split())


@pytest.mark.slow
def test_misplaced_tracks_are_reported(run_egvs, tmp_path: Path) -> None:
    """The car drives 8 m beside High Street."""
    road_map = write_crossing(tmp_path / "map.osm")
    at_m = create_scenario(tmp_path / "first", road_map).junction.at_m
    tracks = write_tracks(tmp_path / "tracks.csv", x_m=at_m[0] - 50.0, y_m=at_m[1] - 9.6)
    options = ["--tracks", tracks, "--track-crs", "world"]
    code, out, err = run_egvs("new", tmp_path / "new", "--from", road_map, *options)
    told = " ".join((out + err).split())
    assert code == 0 and "Check the coordinate system (traffic.track_crs)" in told


@pytest.mark.slow
def test_errors_of_tracks_name_options(run_egvs, tmp_path: Path) -> None:
    road_map, tracks = write_crossing(tmp_path / "map.osm"), write_tracks(tmp_path / "tracks.csv", x_m=9e5)
    far = run_egvs("new", tmp_path / "new", "--from", road_map, "--tracks", tracks)
    assert far[0] == 2 and "--track-crs" in far[2] and "traffic.track_crs" not in far[2]
    tracks.write_text("a,b\n1,2\n")
    unknown = run_egvs("new", tmp_path / "new", "--from", road_map, "--tracks", tracks)
    assert unknown[0] == 2 and "in a TOML file, --track-columns FILE" in " ".join(unknown[2].split())


@pytest.mark.slow
def test_two_statements_of_the_system_are_an_error(run_egvs, tmp_path: Path) -> None:
    road_map, tracks = write_crossing(tmp_path / "map.osm"), write_tracks(tmp_path / "tracks.csv")
    columns = tmp_path / "columns.toml"
    columns.write_text('time = "t"\nid = "who"\nx = "x"\ny = "y"\ndefault_type = "car"\ncrs = "EPSG:25832"\n')
    options = ["--tracks", tracks, "--track-columns", columns, "--track-crs", "world"]
    code, _, err = run_egvs("new", tmp_path / "new", "--from", road_map, *options)
    assert code == 2
    assert "columns.toml: crs: states the system of the tracks already: 'EPSG:25832'. Leave out this key or" in err


def test_track_crs_without_tracks_is_an_error(run_egvs, tmp_path: Path) -> None:
    road_map = write_crossing(tmp_path / "map.osm")
    code, _, err = run_egvs("new", tmp_path / "new", "--from", road_map, "--track-crs", "world")
    assert code == 2
    assert "--track-crs: has no effect without recorded tracks" in err


def test_level_of_traffic_with_tracks_is_an_error(run_egvs, tmp_path: Path) -> None:
    road_map, tracks = write_crossing(tmp_path / "map.osm"), write_tracks(tmp_path / "tracks.csv")
    code, _, err = run_egvs("new", tmp_path / "new", "--from", road_map, "--tracks", tracks, "--traffic", "light")
    assert code == 2
    assert "--traffic: has no effect on recorded traffic" in err


@pytest.fixture(scope="module")
def k733(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not K733.is_dir():
        pytest.skip(f"{K733.name} is not beside the checkout (shared/real)")
    folder = tmp_path_factory.mktemp("new") / "k733"
    options = NewScenarioOptions(tracks=(K733 / "vehicle_tracks_000.csv.gz",))
    create_scenario(folder, K733 / "k733_lanelet2.osm.gz", options=options)
    return folder


@pytest.mark.slow
def test_k733_uses_the_tracks(k733: Path) -> None:
    """The published recording has 74 tracks in 157 s; its junction is at 49.0053 N, 8.4374 E."""
    scenario = egvs.load(k733)
    assert scenario.traffic.tracks == ("tracks/vehicle_tracks_000.csv.gz",)
    assert scenario.assumed == ("surroundings (no building or tree is known)", "positions of the poles")
    assert (k733 / "tracks" / "meta_data.csv").is_file()


@pytest.mark.slow
def test_tracks_and_map_of_k733_agree(k733: Path) -> None:
    from egvs.extensions.tracks.new import files as recorded_traffic

    recorded = recorded_traffic.read_for_summary(egvs.load(k733))
    assert recorded.alignment is not None
    assert recorded.alignment.share > 0.8
    assert not recorded.alignment.fits_better
    assert recorded.tracks.report.tracks == 74


def mirror(table: pa.Table, centre_m: tuple[float, float]) -> pa.Table:
    """Mirror a table of rows of FCD on the middle of a region, in x."""
    changes = {"x": 2.0 * centre_m[0] - table["x"].to_numpy(), "angle": -table["angle"].to_numpy()}
    for name, values in changes.items():
        table = table.set_column(table.schema.get_field_index(name), name, pa.array(values))
    return table


def moved_along(table: pa.Table, lengths_m: Mapping[str, float], share: float) -> pa.Table:
    """Move the vehicles of a table of rows of FCD along their axes by a share of their length."""
    way_m = share * np.array([lengths_m[name] for name in table["type"].to_pylist()])
    yaw_rad = np.deg2rad(90.0 - table["angle"].to_numpy())
    for name, step_m in (("x", way_m * np.cos(yaw_rad)), ("y", way_m * np.sin(yaw_rad))):
        values = pa.array(table[name].to_numpy() + step_m)
        table = table.set_column(table.schema.get_field_index(name), name, values)
    return table


@pytest.mark.slow
def test_vehicles_of_k733_fit_its_roads(k733: Path) -> None:
    """7 % of the positions are more than 1 m beside a lane that leads their way; mirrored, 71 %."""
    scenario = egvs.load(k733)
    recorded = traffic_sources.source_of(scenario).record(scenario, geolocation.scenario_georeference(scenario))
    rows = list(recorded.rows)
    roads, motor_types = sumo_folder.read_network(scenario), frozenset(recorded.sizes) - recorded.uncounted_types
    lengths_m = {name: size.length_m for name, size in recorded.sizes.items()}
    compare = partial(
        road_check.check_tables, roads=roads, region=scenario.roi.box, motor_types=motor_types, lengths_m=lengths_m
    )
    check = compare(rows, are_centres=True)
    assert list(check.findings("tracks")) == []
    assert check.off_lanes < 0.1 * check.positions
    centre_m = scenario.roi.center_m[:2]
    mirrored = [mirror(table, centre_m) for table in rows]
    errors = list(compare(mirrored, are_centres=True).findings("tracks"))
    assert ("vehicles off their lanes", True) in [(error.rule, error.is_error) for error in errors]
    for share, likely in ((0.5, "front bumpers"), (-0.5, "rear bumpers")):
        bumpers = [moved_along(table, lengths_m, share) for table in rows]
        (warning,) = compare(bumpers, are_centres=True).findings("tracks")
        assert (warning.rule, warning.is_error) == ("reference point", False)
        assert f"look like {likely}" in warning.hint


@pytest.mark.slow
def test_position_of_k733_by_hand(k733: Path) -> None:
    """Its first row is 19.36 m west and 33.84 m south of the origin, by the projection's scale of 0.9981 and 1.0010."""
    from egvs.extensions.tracks import recorded_tracks

    scenario = egvs.load(k733)
    world = geolocation.scenario_georeference(scenario)
    assert world.frame is not None
    tracks: Tracks = recorded_tracks.read_in_world_frame(recorded_tracks.track_source(scenario), world)
    row = int(np.flatnonzero((tracks.track == tracks.names.index("5")) & (tracks.time_s == 0.0))[0])
    metres_per_degree = np.array([111_320.0 * np.cos(np.deg2rad(49.0053)), 111_320.0])
    expected_deg = np.array([8.4374089, 49.005306]) + np.array([-19.356829, -33.837784]) / metres_per_degree
    expected_m = world.frame.from_lon_lat(expected_deg[None])[0]
    np.testing.assert_allclose([tracks.x_m[row], tracks.y_m[row]], expected_m, atol=0.1)


@pytest.mark.slow
def test_tracks_far_from_the_map_are_rejected(tmp_path: Path) -> None:
    if not K733.is_dir():
        pytest.skip(f"{K733.name} is not beside the checkout (shared/real)")
    tracks = write_tracks(tmp_path / "vehicle_tracks_000.csv")
    (tmp_path / "meta_data.csv").write_text("id,originLat,originLon\n000,52.0,13.4\n")
    options = NewScenarioOptions(tracks=(tracks,))
    with pytest.raises(InputError, match=r"from the region of interest|from the map"):
        create_scenario(tmp_path / "far", K733 / "k733_lanelet2.osm.gz", options=options)
    assert not (tmp_path / "far").exists()
