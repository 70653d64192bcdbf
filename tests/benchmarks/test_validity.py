"""The study of docs/validity.md: its places, what it keeps, its tables from made-up findings, its page."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.validity import __main__ as command
from benchmarks.validity import (
    agreement,
    detector_sites,
    failures,
    figures,
    heights,
    junctions,
    low_models,
    measurement,
    poses,
    recommended_score,
    study,
    tables,
    undefined_values,
)
from benchmarks.validity.pools import DEFAULT, Pools, Setting
from benchmarks.validity.record import (
    BOXED,
    COUNTED,
    FURTHER_BOX_MEASURES,
    FURTHER_COUNT_MEASURES,
    Estimates,
    Record,
    StudySite,
)

import egvs
from egvs.core.errors import InputError, MissingBackendError
from egvs.extensions.validation.detector_runs import SiteDetectionTask
from egvs.extensions.validation.detectors.pointpillars import SHIPPED_MODEL, OnnxModel
from egvs.sensors.sites import Pose, Site
from tests.conftest import write_mini

pytestmark = pytest.mark.slow  # a study is made for all of them

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


# the places


def test_the_grid_is_the_same_each_time_upright_and_at_all_heights(mini: Path) -> None:
    first, again = (poses.grid_poses(egvs.build_scene(egvs.load(mini)), None, "small") for _ in range(2))
    assert first == again and len(first) == 40
    assert [site.name for site in first[:5]] == ["g01h2", "g01h3", "g01h4.5", "g01h6", "g02h2"]
    assert [site.pose.z_m for site in first[:4]] == [2.0, 3.0, 4.5, 6.0]
    assert all(site.pose.angles_deg == (0.0, 0.0, 0.0) for site in first)
    assert len({(site.pose.x_m, site.pose.y_m) for site in first}) == 10
    assert poses.grid_poses(egvs.build_scene(egvs.load(mini)), None, "small", places=5) == first[:20]


def test_no_place_is_in_the_building_or_outside_the_surroundings(mini: Path) -> None:
    free = poses.free_at(egvs.build_scene(egvs.load(mini)), None, "small")
    x, y = free.T
    assert not ((x > 14) & (x < 18) & (y > 5) & (y < 8)).any()
    assert x.min() == -12.0 and x.max() == 52.0 and y.min() == -22.0 and y.max() == 22.0


def test_sites_are_next_to_lanes_and_heights_are_above_the_slope() -> None:
    scenario = egvs.load(ROOT / "scenarios" / "hill")
    scene = egvs.build_scene(scenario)
    lanes = junctions.Carriageway.of(junctions.sumo_folder.read_network(scenario))
    grid = poses.grid_poses(scene, lanes, "VLP-32C")
    import shapely

    road = shapely.union_all(lanes.areas)
    away = shapely.distance(road, shapely.points([(site.pose.x_m, site.pose.y_m) for site in grid]))
    assert away.min() > 0.0 and away.max() <= poses.ROAD_M
    for site in grid:
        assert 4.0 < site.pose.z_m - float(site.name.partition("h")[2]) < 14.0  # the ground climbs to both sides of 9 m


def test_places_are_spread_as_a_plain_search_spreads_them() -> None:
    rng = np.random.default_rng(5)
    at = rng.uniform(0, 50, (60, 2))
    taken = [min(range(60), key=lambda i: math.dist(at[i], (25, 25)))]
    while len(taken) < 8:
        taken.append(max(range(60), key=lambda i: min(math.dist(at[i], at[j]) for j in taken)))
    assert poses.spread(at, np.array([25.0, 25.0]), 8) == taken


# what is measured and kept


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """The record of the small scenario is 20 s long."""
    monkeypatch.setattr(study, "APART_S", 2.0)
    monkeypatch.setattr(study, "SENSOR_APART_S", 2.0)


def part_of(mini: Path, folder: Path) -> measurement.Part:
    junction = junctions.ready("mini", "training", mini, folder / "world", places=2)
    extent = study.Extent(frames=10, sensor_frames=0, places=2)
    part, *others = study.parts([junction], ["points"], extent, folder)
    assert not others and len(part.sites) == 10 and part.given == {"pole_a", "pole_b"}
    return measurement.Part(**{**vars(part), "scores": ("entropy_seen",)})


def test_a_measured_part_is_reused_and_an_interrupted_one_continues(mini, tmp_path, monkeypatch, short) -> None:
    said: list[str] = []
    part = part_of(mini, tmp_path)
    made = measurement.measure(part, tmp_path, jobs=1, report=said.append)
    assert not said and made.frames == 10 and [site.is_given for site in made.sites[:3]] == [True, True, False]
    assert made.sites[2].height_m == 2.0 and {site.place for site in made.sites[2:6]} == {"g01h2"}
    points = made.detections["points"]["seen_20"]
    assert points.sites == list(range(10)) and max(points.values) <= 1.0
    assert len(made.scores["entropy_seen"]) == 10 and made.sites[9].name == "g02h6"

    monkeypatch.setattr(SiteDetectionTask, "at", lambda *_: pytest.fail("looked again"))
    assert measurement.measure(part_of(mini, tmp_path), tmp_path, jobs=1, report=said.append) == made
    assert said == ["mini: saved before"]
    kept = (tmp_path / "mini.json").read_bytes()
    (tmp_path / "mini.json").unlink()  # as if it had been interrupted before it was whole
    assert measurement.measure(part, tmp_path, jobs=1, report=said.append) == made
    assert said == ["mini: saved before"] and (tmp_path / "mini.json").read_bytes() == kept


def test_a_posed_scenario_has_these_sites_and_no_keys_of_the_old_ones(mini: Path, tmp_path: Path) -> None:
    scenario = egvs.load(mini, ["sites.yaw_deg=30"])
    grid = poses.grid_poses(egvs.build_scene(scenario), None, "small", places=1)
    for sensor in (None, "VLP-16"):
        sites = egvs.build_scene(junctions.with_sites(scenario, grid, tmp_path / "its.csv", sensor)).sites
        assert [(s.name, s.pose) for s in sites] == [(s.name, s.pose) for s in grid]
        assert {s.sensor for s in sites} == {sensor or "small"}


def test_wrong_arguments_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = ["--data", str(tmp_path)]
    assert command.main([*data, "--junction", "tokyo"]) == 2
    assert "--junction: expected some of ingolstadt" in capsys.readouterr().err
    assert command.main([*data, "--detector", "crystal_ball"]) == 2
    assert "unknown detector 'crystal_ball'" in capsys.readouterr().err
    assert command.main([*data, "--junction", "hill", "--osm-held-out", str(tmp_path / "no.osm")]) == 2
    assert "--osm-held-out: no such file" in capsys.readouterr().err


def test_traffic_that_scores_have_seen_is_refused(mini: Path) -> None:
    with pytest.raises(InputError, match=r"traffic\.fcd: the traffic is a finished file"):
        junctions.check_unseen(egvs.load(mini))
    junctions.check_unseen(egvs.load(ROOT / "scenarios" / "hill"))


@pytest.mark.parametrize("other", ["held out", "unseen"])
@pytest.mark.parametrize(("east_m", "far"), [(699.0, False), (701.0, True), (-701.0, True)])
def test_junctions_of_different_roles_lie_apart(
    tmp_path: Path, east_m: float, far: bool, other: junctions.Role
) -> None:
    homes = []
    for role, offset_m in (("training", 0.0), (other, east_m)):
        home = tmp_path / junctions.OSM[role]
        write_mini(home)
        location = f'<location netOffset="{1000.0 - offset_m},5.0" projParameter="+proj=utm +zone=32"/>'
        (home / "network.net.xml").write_text(f"<net>{location}</net>")
        homes.append((home.name, role, home))
    junctions.check_apart(homes[:1])
    if far:
        junctions.check_apart(homes)
    else:
        with pytest.raises(
            InputError,
            match=rf"{other.replace(' ', '-')}: expected at least 700 m to .*, got 699 m",
        ):
            junctions.check_apart(homes)


def given_site(number: int, pole: str, z_m: float) -> Site:
    return Site(f"k{number}", Pose(0.0, 0.0, z_m), "small", pole=pole)


def test_some_of_the_given_sites_are_of_many_poles_and_all_heights() -> None:
    sites = [given_site(3 * p + i, f"p{p}", z) for p in range(12) for i, z in enumerate((3.0, 4.5, 6.0))]
    few = detector_sites.evenly_chosen(sites, 6)
    assert [site.pole for site in few] == ["p0", "p2", "p4", "p6", "p8", "p10"]
    assert [site.pose.z_m for site in few] == [3.0, 4.5, 6.0, 3.0, 4.5, 6.0]
    more = detector_sites.evenly_chosen(sites, 13)
    assert len({site.name for site in more}) == 13 and len({site.pole for site in more}) == 12
    assert sorted(site.pose.z_m for site in more).count(6.0) == 4
    assert detector_sites.evenly_chosen(sites, 36) == detector_sites.evenly_chosen(sites, 99) == sites
    pair = [given_site(0, "a", 2.0), given_site(1, "a", 3.0), given_site(2, "b", 2.0)]
    assert [site.name for site in detector_sites.evenly_chosen(pair, 2)] == ["k0", "k2"]


def test_the_study_is_repeatable_and_names_what_was_left_out(tmp_path, monkeypatch, capsys, short) -> None:
    (tmp_path / "scenarios").mkdir()
    for name in ("ingolstadt", "nishishinjuku"):
        write_mini(tmp_path / "scenarios" / name)
    monkeypatch.setattr(junctions, "SCENARIOS", tmp_path / "scenarios")
    monkeypatch.setattr(study, "SENSORS", ("VLP-16",))
    monkeypatch.setattr(junctions, "check_unseen", lambda scenario: None)  # these have a finished file
    options = ["--frames", "10", "--sensor-frames", "10", "--places", "2", "--jobs", "1", "--detector", "points"]
    docs = [tmp_path / "first", tmp_path / "again"]
    for folder in docs:
        code = command.main([*options, "--data", str(tmp_path / "data"), "--docs", str(folder)])
        out, err = capsys.readouterr()
        assert code == 0, err
        assert "ingolstadt: training, small, 10 frames 2 s apart, points from 10" in out
        assert "3 parts; detectors take about 0 minutes on 1 cores" in out
    assert out.count(": saved before") == 3
    made = sorted(path.relative_to(docs[0]) for path in docs[0].rglob("*") if path.is_file())
    assert {str(path) for path in made if path.suffix not in (".png", ".csv")} == {
        "data/validity/tables.json", "validity-costs.md",
    }  # fmt: skip
    assert {path.parent for path in made if path.suffix == ".csv"} == {Path("data/validity")}
    assert all((docs[0] / path).read_bytes() == (docs[1] / path).read_bytes() for path in made)
    conditions = " ".join(tables.read(docs[0] / command.DATA)[0])
    assert (
        "Without: hill (not in this run); roundabout (not in this run); a training junction from OpenStreetMap"
        in conditions
    )
    assert "Detectors: points." in conditions and "ingolstadt: TPOG 7, held-out traffic" in conditions


# tables from made-up findings


def make_record(name: str, role: str, *, boxes: bool = True) -> Record:
    """Six places at four heights and six given sites; detection falls by a hundredth a metre of height, and grows with
    the number of the place; ``entropy_seen`` foretells it, EGVS the opposite but for gamma 2."""
    rng = np.random.default_rng(len(name))
    sites = [StudySite(f"k{i}", f"k{i}", 3.0, 20.0, True) for i in range(6)]
    sites += [StudySite(f"g{i}h{h:g}", f"g{i}", h, 20.0, False) for i in range(6) for h in poses.HEIGHTS_M]
    values = np.array([0.5 + 0.05 * int(s.place[1:]) - 0.01 * s.height_m + (0.003 if s.is_given else 0) for s in sites])
    left_out = values[:, None] + 0.001 * rng.normal(size=(len(sites), 10))
    its = Estimates(list(range(len(sites))), values.tolist(), [0.01] * len(sites), left_out.tolist())
    detections = {"points": {m: its for m in (*COUNTED, *FURTHER_COUNT_MEASURES)}}
    if boxes:
        detections["cluster"] = {m: its for m in (*BOXED, *FURTHER_BOX_MEASURES)}
        detections[low_models.SENSOR] = {m: its.only(set(range(6, 26))) for m in detections["cluster"]}
    settings = [Setting(g, v, o) for g in (1.0, 2.0, 10.0) for v in (0.25, 1.0) for o in (False, True)]
    scores = {str(s): (values * (1 if s.gamma == 2 else -1) + 3).tolist() for s in settings}
    scores["entropy_seen"] = values.tolist()
    scores["constant"] = [1.0] * len(sites)
    return Record("", name, role, "VLP-32C", 50, 200, {"TPOG": 1, "unseen": 2}, sites, scores, detections)


@pytest.fixture(scope="module")
def records() -> list[Record]:
    return [
        make_record("left", "training"),
        make_record("hilly", "training", boxes=False),
        make_record("right", "held out"),
    ]


@pytest.fixture(scope="module")
def all_tables(records: list[Record]) -> list[tables.Table]:
    return list(study.tables_of(records, records[:1], ["points", "cluster", "pointpillars", low_models.SENSOR]))


def table(all_tables: list[tables.Table], name: str) -> tables.Table:
    return next(its for its in all_tables if its.name == name)


def test_rho_of_each_setting_is_that_of_the_findings(all_tables: list[tables.Table]) -> None:
    its = table(all_tables, "A points seen_20")
    assert [c.heading for c in its.columns[3:]] == ["left", "hilly", "right", "training", "held out"]
    for row in its.rows:
        assert all(cell[0] == (1.0 if row[0] == "2" else -1.0) for cell in row[3:])
    assert [c.heading for c in table(all_tables, "A cluster ap_mean_r40_iou70").columns[3:]] == [
        "left", "right", "training", "held out",
    ]  # fmt: skip


def test_the_low_models_are_there_for_heights_alone(all_tables: list[tables.Table]) -> None:
    its = low_models.SENSOR
    with_it = [t.name for t in all_tables if its in t.name or its in [cell for row in t.rows for cell in row]]
    assert with_it == ["0 measured", "C heights"]


def test_where_each_detector_looks_from(mini: Path, tmp_path: Path) -> None:
    junction = junctions.ready("mini", "training", mini, tmp_path)
    each = ("points", "cluster", "other", *low_models.NAMES)
    for role, right in (("training", [42, 42, 22, 0, 0]), ("held out", [42, 42, 22, 20, 20])):
        its = replace(junction, role=role)
        assert [len(detector_sites.sites_of(name, its)) for name in each] == right
    assert {site.name[:3] for site in detector_sites.sites_of(low_models.LOW, its)} == {f"g0{n}" for n in range(1, 6)}


def test_no_shipped_model_has_seen_a_held_out_junction() -> None:
    shipped = ["ingolstadt", "hill", "roundabout"]
    made_for_it = [f"detector_{name}" for name in ("grid", "queue", "left", "slope", "people")]
    for model, convention, heights_m, trained_at in (
        (SHIPPED_MODEL, "ground", [2.0, 8.0], [*shipped, *made_for_it]),
        (low_models.model(low_models.LOW), "ground", [2.0, 2.0], [*shipped, "east"]),
        (low_models.model(low_models.SENSOR), "sensor", [2.0, 2.0], [*shipped, "east"]),
    ):
        about = OnnxModel.load(model).metadata
        assert about["convention"] == convention and about["recipe"]["heights_m"] == heights_m
        assert about["junctions"] == trained_at


def test_a_model_that_is_not_there_is_left_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(low_models, "model", lambda name: tmp_path / f"{name}.onnx")
    with pytest.raises(MissingBackendError, match=r"pointpillars_2m\.onnx is not there"):
        low_models.make(low_models.LOW)


def test_own_sites_the_grid_and_each_height_are_compared_alone(records: list[Record], all_tables) -> None:
    its = table(all_tables, "A sites points seen_20")
    assert its.column("sites") == ["all", "given", "grid", *(f"grid, {h:g} m" for h in poses.HEIGHTS_M)] * 2
    assert all(cell[0] == (-1.0 if row[0] == str(DEFAULT) else 1.0) for row in its.rows for cell in row[2:])
    of_grid = records[0].only(lambda site: not site.is_given)
    assert of_grid.junction_of("points").sites == tuple(site.name for site in records[0].sites[6:])
    nowhere = Pools([records[0].only(lambda site: False)], "points")
    assert math.isnan(nowhere.rho("left", "entropy_seen", "seen_20").value)


def test_gamma_is_chosen_on_training_junctions_whatever_the_held_out_ones_say(records: list[Record]) -> None:
    other = Record(**{**vars(records[2]), "scores": {
        name: [-v for v in its] for name, its in records[2].scores.items()}})  # fmt: skip
    its = agreement.chosen_gamma([Pools([*records[:2], other], "points", 200)])
    assert set(its.column("best gamma, training")) == {"2"} and set(
        its.column("gammas not distinguishable from it")
    ) == {"2"}
    assert all(cell[0] == 1.0 for cell in its.column("rho, training"))
    assert all(cell[0] == -1.0 for cell in its.column("rho, held out"))
    assert all(cell[0] == -2.0 for cell in its.column("difference, held out"))


def test_scores_are_ranked_by_training_junctions_and_one_without_order_comes_last(all_tables) -> None:
    its = table(all_tables, "D points seen_20")
    assert its.column("score") == [str(Setting(2.0, 0.25, False)), "entropy_seen", str(DEFAULT), "constant"]
    assert its.rows[2][3] is None and its.rows[2][4][0] == -2.0  # the default, less itself, and less the best
    assert its.rows[3][1:] == [None] * 4


def test_heights_are_compared_place_by_place(records: list[Record]) -> None:
    its = heights.table(records, ["points", "pointpillars"])
    assert set(its.column("detector")) == {"points"}
    assert its.column("junction") == ["left", "hilly", "right", "training", "held out"] * 2
    every = its.rows[3]
    assert every[3] == 12
    means = [cell[0] for cell in every[4:8]]
    assert means == pytest.approx([100 * (0.625 - 0.01 * h) for h in poses.HEIGHTS_M])
    assert [cell[0] for cell in every[8:]] == pytest.approx([-1.0, -2.5, -4.0])
    for value, low, high in every[8:]:
        assert low < value < high and high - low < 0.8  # places share their differences; frames scatter by a little


def test_heights_of_two_detectors_are_compared_at_the_same_sites(records: list[Record]) -> None:
    record = records[2]
    low = {m: its.only(set(range(6, 26))) for m, its in record.detections["cluster"].items()}  # 5 of the 6 places
    less = {
        m: replace(its, values=[v - 0.02 * (2.0 + i % 4) for i, v in enumerate(its.values)]) for m, its in low.items()
    }
    both = replace(record, detections=record.detections | {low_models.LOW: low, low_models.SENSOR: less})
    its = heights.table([both], ["points", low_models.LOW, low_models.SENSOR])
    names = ["points", low_models.LOW, low_models.SENSOR, "points, first 5 locations"]
    assert list(dict.fromkeys(its.column("detector"))) == [*names, f"{low_models.SENSOR} minus {low_models.LOW}"]
    gap = its.rows[-1]
    assert gap[2] == "held out" and gap[3] == 5
    assert [cell[0] for cell in gap[4:8]] == pytest.approx([-4.0, -6.0, -8.0, -10.0])
    assert [cell[0] for cell in gap[8:]] == pytest.approx([-2.0, -4.0, -6.0])


def test_undefined_values_are_listed(records: list[Record]) -> None:
    its = records[0].detections["points"]
    values = [math.nan, *its["seen_20"].values[1:]]
    holed = replace(
        records[0],
        detections={"points": its | {"seen_20": replace(its["seen_20"], values=values)}},
        skipped=["voxel 1 m: does not fit"],
    )
    rows = undefined_values.table([Pools([holed], "points", 200)], [holed]).rows
    assert ["points", "share of vehicles with 20 points", "training", "entropy_seen", 29, "left k0", None] in rows
    assert [row[6] for row in rows if row[3] == "constant"] == ["constant is the same at all sites of left"] * 2
    assert rows[-1] == [None, None, "left", None, None, None, "voxel 1 m: does not fit"]


def test_failures_are_the_sites_whose_ranks_differ_most(records: list[Record]) -> None:
    rows = failures.worst(records[0], "points", "seen_20", "entropy_seen")
    assert [row[5] == row[6] for row in rows] == [True] * 3  # this score makes no mistake
    best, *_ = sorted(records[0].sites, key=lambda s: -(0.05 * int(s.place[1:]) - 0.01 * s.height_m))
    row = failures.worst(records[0], "points", "seen_20", str(DEFAULT))[0]
    assert row[2] == best.name or row[5:7] == [1, 30] or row[5:7] == [30, 1]


def test_one_gamma_is_held_against_each_sensor_and_voxel_size(all_tables: list[tables.Table]) -> None:
    assert set(table(all_tables, "B sensors").column("best gamma")) == {"2"}
    its = table(all_tables, "B one gamma")
    assert its.column("one gamma")[0] == "2" and its.column("higher better")[0] == its.column("lower better")[0] == 0


def test_figures_are_drawn_from_the_tables_twice_alike(all_tables: list[tables.Table], tmp_path: Path) -> None:
    few = [its for its in all_tables if its.name in ("A points seen_20", "C heights", "D points seen_20")]
    first, again = (figures.draw(tmp_path / name, few) for name in "ab")
    assert [path.name for path in first] == ["validity-gamma.png", "validity-heights.png", "validity-scores.png"]
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in again]


def test_tables_survive_a_round_trip_through_csv(all_tables: list[tables.Table], tmp_path: Path) -> None:
    tables.write(tmp_path, ["Conditions."], all_tables)
    preface, back = tables.read(tmp_path)
    assert back == all_tables and preface == ["Conditions."]
    assert len(tables.file_names(tmp_path)) == len(all_tables)
    assert {path.name for path in tmp_path.glob("*.csv")} == set(tables.file_names(tmp_path))


def test_files_of_an_earlier_study_are_removed(all_tables: list[tables.Table], tmp_path: Path) -> None:
    (tmp_path / "old.csv").write_text("table\n")
    tables.write(tmp_path, [], all_tables[:1])
    assert [path.name for path in tmp_path.glob("*.csv")] == tables.file_names(tmp_path)


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        (None, "-"),
        (0.456, "0.46"),
        (-0.001, "0.00"),
        ([0.5, None, None], "0.50"),
        ([0.5, -0.12, 1], "0.50 (-0.12 to 1.00)"),
    ],
)
def test_cells_as_text(cell: tables.Cell, text: str) -> None:
    assert tables.format_number(cell, "two") == text


# the page


def test_the_page_of_tables_links_and_shows_each_file() -> None:
    page = (DOCS / "validity-tables.md").read_text(encoding="utf-8")
    folder = DOCS / command.DATA
    headings = {table.section for table in tables.read(folder)[1]}
    assert set(re.findall(r"^## (.*)$", page, re.MULTILINE)) == headings
    for file in tables.file_names(folder):
        assert f"({command.DATA.as_posix()}/{file})" in page
        assert f"<!-- study table {Path(file).stem} -->" in page


def test_every_number_of_the_answers_stands_in_the_tables() -> None:
    """Numbers with a decimal point: those are measured."""
    answers = (DOCS / "validity.md").read_text(encoding="utf-8").partition("\n## Answers\n")[2]
    answers = answers.partition("\n## Detectors that measure heights")[0]  # numbers of other programs follow
    shown = set(re.findall(r"\d+\.\d+", tables.page("", *tables.read(DOCS / command.DATA))))
    settings = {"0.25", "0.5", "4.5", "0.7"}
    assert set(re.findall(r"\d+\.\d+", answers)) <= shown | settings


def test_the_protocol_says_the_numbers_of_the_program() -> None:
    page = " ".join((DOCS / "validity.md").read_text(encoding="utf-8").split())
    assert f"evaluated with {study.FRAMES} frames of another seed, {study.APART_S:g} s apart" in page
    assert f"on {study.SENSOR_FRAMES} frames {study.SENSOR_APART_S:g} s apart" in page
    assert (
        f"first {detector_sites.FEW_PLACES} locations" in page
        and f"at most {detector_sites.FEW_GIVEN['held out']} of the given" in page
    )
    assert f"{detector_sites.FEW_GIVEN['training']} of a training one" in page
    assert ", ".join(study.SENSORS) in page and f"{poses.PLACES} locations, each at 2, 3, 4.5 and 6 m" in page
    assert f"lattice of {poses.SPACING_M:g} m that reaches {poses.MARGIN_M:g} m" in page
    assert f"within {poses.ROAD_M:g} m of a lane" in page
    for name, role in junctions.SHIPPED.items():
        assert re.search(rf"\| {name} \|[^|]*\| {role} \|", page), name
    assert tables.read(DOCS / command.DATA)[0]


# the score that is recommended


def recommended(name: str, role: str) -> Record:
    """As above, with the recommended score as good as can be, and a junction that is unseen beside one held out."""
    record = make_record(name, role)
    values = record.detections["cluster"][BOXED[0]].values
    return replace(record, scores=record.scores | {recommended_score.RECOMMENDED: values, "seen_well": values})


def test_the_recommended_score_is_quoted_only_for_untrained_junctions_and_changes_no_earlier_table() -> None:
    its = [recommended("left", "training"), recommended("right", "held out"), recommended("north", "unseen")]
    made = list(recommended_score.tables(its, ["cluster", low_models.SENSOR]))
    found = table(made, f"F cluster {BOXED[0]}")
    assert found.column("junction")[:3] == ["right", "north", "together"]
    assert found.column("number of sites")[:9] == [30, 30, 60, 6, 6, 12, 24, 24, 48]
    assert all(cell[0] == 1.0 for cell in found.column("recommended"))
    assert all(cell[0] == -1.0 for cell in found.column("EGVS, gamma 10"))
    assert found.column("best EGVS setting here")[0] == "(gamma 2, voxel 0.25)"  # as good as can be too
    assert found.column("recommended minus that")[0][0] == 0.0
    assert found.column("recommended minus gamma 10")[0][0] == 2.0
    worst = table(made, "F worst cluster")
    assert len(worst.rows) == 6 and worst.column("rank by score") == worst.column("rank by detection")
    every = table(made, "F all")
    rho = dict(zip(every.column("score"), every.column("cluster"), strict=True))
    assert rho[recommended_score.RECOMMENDED][0] == 1.0 and rho[str(DEFAULT)][0] == -1.0
    assert every.column("score")[-1] == "constant" and rho["constant"] is None  # the same everywhere
    assert len(made) == 4  # none of detectors that are there for heights alone
    assert recommended_score.without_later_scores(its) == [
        make_record("left", "training"),
        make_record("right", "held out"),
    ]


def test_records_without_the_recommended_score_have_no_table_of_it(all_tables: list[tables.Table]) -> None:
    assert not [its for its in all_tables if its.name.startswith("F")]
