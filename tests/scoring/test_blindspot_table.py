"""``blindspots.parquet`` of whole runs: what adds up, same bytes, the switch, periods, and files that are not sound."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import egvs
from egvs.artefacts import parquet, readers
from egvs.core.errors import InputError
from egvs.runs.run_context import open_folder
from egvs.scenario import loading, model
from egvs.scoring.target_scores import detection_chances
from egvs.scoring.targets import TargetRecord, visible_targets
from egvs.stages import scan, score, statics
from egvs.stages.site_scans import empty_scans
from egvs.stages.site_scoring import vehicle_spots
from tests.conftest import SITES, write_mini
from tests.scoring.roads import GRID, NETWORK
from tests.scoring.target_scenes import frame
from tests.scoring.test_blindspots import car
from tests.stage_runner import inputs_of, run_stage

NET = "made.net.xml"


def rows_of(out: Path, site: str) -> list[dict]:  # type: ignore[type-arg]
    """Of one site."""
    return [row for row in pq.read_table(out / "blindspots.parquet").to_pylist() if row["site"] == site]


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A scenario with a finished FCD file, and its run's folder."""
    folder = tmp_path_factory.mktemp("ran")
    mini = write_mini(folder / "mini")
    egvs.run(loading.load(mini), folder / "run", jobs=1)
    return mini, folder / "run"


@pytest.fixture(scope="module")
def on_roads(tmp_path_factory: pytest.TempPathFactory) -> tuple[model.Scenario, Path]:
    """A scenario that simulates on the made-up network, and a folder with made-up traffic, scans and scores."""
    folder = tmp_path_factory.mktemp("on_roads")
    (folder / NET).write_text(NETWORK)
    (folder / "sites.csv").write_text(SITES)
    sensor = {"elevations_deg": [-25, 5], "channels": 16, "azimuth_step_deg": 0.5, "range_m": 100}
    values = {
        "name": "on_roads",
        "roi": {"center_m": [30, 0, 2.5], "size_m": [60, 40, 5], "voxel_m": 1},
        "traffic": {"network": NET, "frames": 40, "warmup_s": 0},
        "sites": {"file": "sites.csv", "sensor": "small"},
        "sensors": {"small": sensor},
    }
    scenario, out = loading.scenario_from_dict(values, folder, str(folder / "scenario.toml")), folder / "out"
    out.mkdir()
    boxes = [(n, f"v{n % 12}-{lane}", car(17 + n % 11, lane)) for n in range(40) for lane in (-1.6, -4.8)]
    boxes += [(n, "lost", car(50, 15)) for n in range(0, 40, 4)]
    boxes.sort(key=lambda its: its[:2])
    names = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_rad")
    columns = {name: [box[i] for _, _, box in boxes] for i, name in enumerate(names)}
    columns |= {"frame": [n for n, *_ in boxes], "vehicle": [name for _, name, _ in boxes]}
    columns |= {"part": [0] * len(boxes), "kind": ["passenger"] * len(boxes), "pitch_rad": [0.0] * len(boxes)}
    parquet.write_artefact(out / "trajectories.parquet", "trajectories", columns, {"schema": 1, "frames": 40})
    grid = scenario.roi.grid
    index = {name: np.array([5], dtype=np.int32) for name in ("ix", "iy", "iz")}
    index["iz"] = np.array([0], dtype=np.int32)
    counts = {"block": np.array([0], dtype=np.uint16), **index, "count": np.array([20], dtype=np.uint32)}
    about = {"schema": 1, "grid": grid.to_json(), "frames": 40, "block_frames": 40, "memory_frames": 1.0}
    parquet.write_artefact(out / "tpog.parquet", "tpog", counts, about)
    for stage in (statics, scan, score):
        run_stage(stage, scenario, out, jobs=1)
    return scenario, out


def test_vehicle_frames_add_up(on_roads: tuple[model.Scenario, Path]) -> None:
    _, out = on_roads
    for site in ("pole_a", "pole_b"):
        rows = rows_of(out, site)
        count = {by: sum(r["vehicle_frames"] for r in rows if r["by"] == by) for by in {r["by"] for r in rows}}
        assert count["all"] == 90 == count["lane"] + count.get("turn", 0) + count["no lane"]
        assert count["no lane"] == 10 and count["approach"] == 80
        seen = {by: sum(r["with_points"] for r in rows if r["by"] == by) for by in count}
        assert 0 < seen["all"] == seen["lane"] + seen.get("turn", 0) + seen["no lane"]
        found = {by: sum(r["share_found"] * r["vehicle_frames"] for r in rows if r["by"] == by) for by in count}
        assert found["all"] == pytest.approx(found["lane"] + found.get("turn", 0) + found["no lane"])
        for row in rows:
            assert (row["ix"] >= 0) == (row["iy"] >= 0) == (row["by"] == "cell") == (row["words"] == "")
    keys = [(r["by"], r["place"], r["ix"], r["iy"]) for r in rows_of(out, "pole_a")]
    assert (
        keys == [(r["by"], r["place"], r["ix"], r["iy"]) for r in rows_of(out, "pole_b")] == list(dict.fromkeys(keys))
    )


def test_the_share_found_of_all_vehicles_is_the_score(on_roads: tuple[model.Scenario, Path]) -> None:
    _, out = on_roads
    scores = {
        row["site"]: row["expected_detections"] for row in readers.read_scores(out / "scores.parquet").to_pylist()
    }
    assert len(scores) == 2
    for site, score_of_site in scores.items():
        (whole,) = (row for row in rows_of(out, site) if row["by"] == "all")
        assert whole["share_found"] == pytest.approx(score_of_site)


def test_counts_are_those_of_the_points(on_roads: tuple[model.Scenario, Path]) -> None:
    scenario, out = on_roads
    record = TargetRecord.read(out / "trajectories.parquet", scenario.roi.grid)
    for its in empty_scans(open_folder(scenario, out)):
        visible = visible_targets(record, its.beams)
        left = record.boxes[:, 1] == -1.6
        rows = {row["place"]: row for row in rows_of(out, its.site.name) if row["by"] == "lane"}
        assert rows["near_2"]["with_points"] == int((visible.points[left] >= 20).sum())
        assert rows["near_2"]["share_found"] == pytest.approx(detection_chances(visible)[left].mean())
        assert rows["near_2"]["words"] == "High Street (west), left-turn lane"
        assert (rows["near_2"]["vehicle_frames"], rows["near_2"]["vehicles"]) == (40, 12)


def test_inputs_and_metadata_of_blind_spots(on_roads: tuple[model.Scenario, Path]) -> None:
    scenario, out = on_roads
    assert {"network", "trajectories.parquet"} <= inputs_of(score, scenario, out).files.keys()
    about = parquet.read_metadata(out / "blindspots.parquet", "blindspots")
    assert about["cells"] == {"origin_m": [0.0, -20.0], "cell_m": 1.0, "shape": [60, 40]} and about["points"] == 20.0
    (site,) = readers.read_blindspots(out / "blindspots.parquet", {"pole_b"})
    assert (site.site, site.off_lanes, site.share_missed.shape) == ("pole_b", 10, (60, 40))


@pytest.mark.slow
def test_another_number_of_threads_writes_the_same_bytes(
    on_roads: tuple[model.Scenario, Path], ran: tuple[Path, Path], tmp_path: Path
) -> None:
    scenario, out = on_roads
    before = (out / "blindspots.parquet").read_bytes()
    run_stage(score, scenario, out, jobs=3)
    assert (out / "blindspots.parquet").read_bytes() == before
    egvs.run(loading.load(ran[0]), tmp_path / "again", jobs=2)
    assert (tmp_path / "again" / "blindspots.parquet").read_bytes() == (ran[1] / "blindspots.parquet").read_bytes()


def test_recorded_traffic_has_a_map_alone(ran: tuple[Path, Path]) -> None:
    mini, out = ran
    assert {row["by"] for row in rows_of(out, "pole_a")} == {"all", "cell"}
    assert "network" not in inputs_of(score, loading.load(mini), out).files
    (site, _) = readers.read_blindspots(out / "blindspots.parquet")
    assert site.overall is not None and site.overall.vehicles == 2 and site.worst == [] and site.off_lanes == 0
    assert np.isfinite(site.share_missed).sum() == sum(row["by"] == "cell" for row in rows_of(out, "pole_a"))


@pytest.mark.slow
def test_blindspots_can_be_disabled(ran: tuple[Path, Path], tmp_path: Path) -> None:
    off = loading.load(ran[0], ["score.blindspots=false"])
    egvs.run(loading.load(ran[0]), tmp_path, jobs=1)
    assert (tmp_path / "blindspots.parquet").is_file() and 'data-view="vehicles"' in (
        tmp_path / "report.html"
    ).read_text()
    record = egvs.run(off, tmp_path, jobs=1)
    assert not (tmp_path / "blindspots.parquet").exists() and "missed" not in record.stages["score"].summary
    assert 'data-view="vehicles"' not in (tmp_path / "report.html").read_text()


@pytest.mark.slow
def test_a_mix_of_periods_weighs_its_vehicles(tmp_path: Path) -> None:
    halves = '[{name="a", length_s=12, weight=3}, {name="b", begin_s=12, length_s=8}]'
    mini = write_mini(tmp_path / "mini")
    egvs.run(loading.load(mini, [f"traffic.periods={halves}"]), tmp_path / "run", jobs=1)
    whole = rows_of(tmp_path / "run", "pole_b")[0]
    scenario = loading.load(mini, [f"traffic.periods={halves}"])
    record = TargetRecord.read(tmp_path / "run" / "trajectories.parquet", scenario.roi.grid)
    of_a = record.numbers[record.frame] < 24
    its = {it.site.name: it for it in empty_scans(open_folder(scenario, tmp_path / "run"))}
    visible = visible_targets(record, its["pole_b"].beams)
    chances, weights = detection_chances(visible), np.array([3 / 24, 1 / 16])
    parts = np.array([chances[of_a].sum(), chances[~of_a].sum()])
    assert whole["vehicles"] == len({*record.vehicle[of_a]}) + len({*record.vehicle[~of_a]})
    assert whole["with_points"] == int((visible.points >= 20).sum()) and whole["vehicle_frames"] == len(record)
    expected = parts @ weights / ([of_a.sum(), (~of_a).sum()] @ weights)
    assert whole["share_found"] == pytest.approx(expected)
    rows = rows_of(tmp_path / "run", "pole_b")
    assert all(row["weight"] > 0 for row in rows)


@pytest.mark.parametrize(("second", "named"), [("made.net.xml", True), ("other.net.xml", False)])
def test_periods_on_networks_of_their_own_have_a_map_alone(tmp_path: Path, second: str, named: bool) -> None:
    for net in (NET, "other.net.xml"):
        (tmp_path / net).write_text(NETWORK)
    for name, net in (("day", NET), ("night", second)):
        config = f'<configuration><net-file value="{net}"/><route-files value="r.rou.xml"/></configuration>'
        (tmp_path / f"{name}.sumocfg").write_text(config)
    periods = [{"name": name, "sumocfg": f"{name}.sumocfg"} for name in ("day", "night")]
    values = {
        "name": "two",
        "roi": {"center_m": [30, 0, 2.5], "size_m": [60, 40, 5]},
        "traffic": {"frames": 40, "periods": periods},
        "sites": {"grid": {"low_m": [0, 0], "high_m": [1, 1], "spacing_m": 1, "heights_m": [3]}, "sensor": "VLP-16"},
    }
    scenario = loading.scenario_from_dict(values, tmp_path, str(tmp_path / "scenario.toml"))
    context = open_folder(scenario, tmp_path)
    assert context.inputs.common_network_path == (tmp_path / NET if named else None)
    record = TargetRecord.of([frame([car(20, -4.8)])], GRID)
    spots = vehicle_spots(context, record, [40, 40], np.ones(1))
    assert {place.by for place in spots.locations} == ({"all", "approach", "lane"} if named else {"all"})


def test_without_vehicles_there_is_nothing_to_miss(tmp_path: Path) -> None:
    mini = write_mini(tmp_path / "mini")
    text = (mini / "fcd.csv").read_text().replace(";-2.0;", ";-200.0;").splitlines()
    (mini / "fcd.csv").write_text("\n".join(line for line in text if ";west;" not in line) + "\n")
    record = egvs.run(loading.load(mini), tmp_path / "run", jobs=1)
    (found, *_) = readers.read_blindspots(tmp_path / "run" / "blindspots.parquet")
    assert found.in_words() == "no vehicle in the region of interest, so none that pole_a misses"
    assert "missed" not in record.stages["score"].summary, "no site is best where none sees anything"
    assert pq.read_table(tmp_path / "run" / "blindspots.parquet").num_rows == 0


def damaged(path: Path, out: Path, change) -> Path:  # type: ignore[no-untyped-def]
    """A copy of an artefact in which something is changed: its table, and the groups of rows that it is written in."""
    file = pq.ParquetFile(path)
    table, per_group = change(file.read(), file.metadata.row_group(0).num_rows)
    with pq.ParquetWriter(out, table.schema) as writer:
        for start in range(0, len(table), per_group):
            writer.write_table(table.slice(start, per_group), row_group_size=per_group)
        writer.add_key_value_metadata({b"egvs": file.metadata.metadata[b"egvs"]})
    return out


def outside(table: pa.Table, groups: int) -> tuple[pa.Table, int]:
    """A square beyond the region."""
    ix = np.where(table.column("ix").to_numpy() >= 0, 60, -1).astype(np.int32)
    return table.set_column(table.schema.get_field_index("ix"), table.schema.field("ix"), [ix]), groups


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (outside, "a cell of site pole_a lies outside the region"),
        (lambda table, rows: (table, rows * 2), "expected 2 row groups for 2 sites, got 1"),
        (lambda table, rows: (table.drop_columns(["words"]), rows), "the column 'words' is missing"),
    ],
)
def test_error_names_damaged_file(  # type: ignore[no-untyped-def]
    on_roads: tuple[model.Scenario, Path], tmp_path: Path, change, message: str
) -> None:
    path = damaged(on_roads[1] / "blindspots.parquet", tmp_path / "blindspots.parquet", change)
    with pytest.raises(InputError) as error:
        list(readers.read_blindspots(path))
    assert message in str(error.value) and str(path) in str(error.value)


@pytest.mark.parametrize("cells", [None, {}, {"origin_m": [0, 0], "cell_m": 0, "shape": [1, 1]}, {"origin_m": [0]}])
def test_rejects_invalid_cells_in_metadata(
    on_roads: tuple[model.Scenario, Path], tmp_path: Path, cells: object
) -> None:
    about = parquet.read_metadata(on_roads[1] / "blindspots.parquet", "blindspots") | {"cells": cells}
    columns = pq.read_table(on_roads[1] / "blindspots.parquet").to_pydict()
    parquet.write_artefact(tmp_path / "blindspots.parquet", "blindspots", columns, about)
    with pytest.raises(InputError, match="invalid metadata: cells = "):
        list(readers.read_blindspots(tmp_path / "blindspots.parquet"))


def test_report_rejects_truncated_file(ran: tuple[Path, Path], tmp_path: Path, run_egvs) -> None:  # type: ignore[no-untyped-def]
    egvs.run(loading.load(ran[0]), tmp_path, jobs=1)
    path = tmp_path / "blindspots.parquet"
    path.write_bytes(path.read_bytes()[:-100])
    code, _, told = run_egvs("report", ran[0], "--out", tmp_path)
    assert code == 2 and "blindspots.parquet: was altered or replaced" in " ".join(told.split())


@pytest.mark.slow
def test_many_sites_share_row_groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_STORE", "")  # which would hold the other's
    more = "".join(f"more_{i},{12 + i},9,3\n" for i in range(3))
    folder = write_mini(tmp_path / "mini")
    (folder / "sites.csv").write_text(SITES + more)
    found = {}
    for most, sites in ((1000, [1] * 5), (3, [2, 2, 1])):
        monkeypatch.setattr(readers, "_MAX_ROW_GROUPS", most)
        path = tmp_path / f"run{most}" / "blindspots.parquet"
        egvs.run(loading.load(folder), path.parent, jobs=1)
        about, rows = pq.read_metadata(path), pq.read_metadata(path).num_rows // 5
        assert [about.row_group(i).num_rows for i in range(about.num_row_groups)] == [rows * count for count in sites]
        found[most] = path, list(readers.read_blindspots(path))
    for alone, shared in zip(found[1000][1], found[3][1], strict=True):
        assert (alone.site, alone.locations) == (shared.site, shared.locations)
        np.testing.assert_array_equal(alone.share_missed, shared.share_missed)
    (path, whole), only = found[3], {"pole_b", "more_2"}
    assert [its.site for its in readers.read_blindspots(path, only)] == ["pole_b", "more_2"]
    assert [its.locations for its in readers.read_blindspots(path, only)] == [whole[1].locations, whole[4].locations]
    assert pq.read_table(found[1000][0]).to_pandas().equals(pq.read_table(path).to_pandas())
