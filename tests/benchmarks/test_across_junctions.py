"""The larger study: protocol and its hash, candidates, statistics and tables on made-up records, and the command."""

from __future__ import annotations

import json
import math
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
import shapely
from benchmarks.across_junctions import __main__ as command
from benchmarks.across_junctions import (
    build,
    calibration,
    candidates,
    costs,
    detections,
    furniture,
    measurement,
    records,
    statistics,
    study_detectors,
    table_files,
    tables,
    training,
    vehicle_rows,
    worlds,
)
from benchmarks.across_junctions.candidates import with_sites
from benchmarks.across_junctions.detections import AP, MEASURES
from benchmarks.across_junctions.models.additive_model import DIRECTIONS
from benchmarks.across_junctions.protocol import (
    FOLDER,
    FROZEN_FILE,
    JUNCTIONS_FILE,
    MIN_SITES_OF_A_HEIGHT,
    Furniture,
    MapFile,
    ProtocolFiles,
    Terrain,
    check_frozen,
    detector_junctions,
    frozen_again,
    read_protocol,
    write_frozen,
)
from benchmarks.across_junctions.records import VEHICLES, PartInfo, write_table
from benchmarks.across_junctions.statistics import DetectedJunction, Estimate
from benchmarks.across_junctions.worlds import SCENARIOS

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core.errors import InputError, MissingBackendError
from egvs.extensions.validation import surrogates
from egvs.extensions.validation.correlation import MeasureValues
from egvs.extensions.validation.detectors import cluster
from egvs.extensions.validation.detectors.pointpillars import SHIPPED_MODEL, OnnxModel
from egvs.extensions.validation.held_out_traffic import prepare_held_out_traffic
from egvs.runs import stage_keys
from egvs.scenario.loading import load
from egvs.scoring.target_scores import DETECTORS, FEATURES, MODELLED, DetectabilityModel, uncorrected_model
from egvs.sensors.sensor import CATALOGUE
from egvs.sensors.sites import Pose, Site
from egvs.stages.inputs import build_scene
from egvs.traffic import sumo_folder
from egvs.world.carriageway import Carriageway
from tests.conftest import write_mini

DOCS = Path(__file__).resolve().parents[2] / "docs"


# ---- protocol


def test_the_protocol_has_enough_junctions_and_none_of_them_twice() -> None:
    protocol = read_protocol()
    by_role = {role: [j for j in protocol.junctions if j.role == role] for role in ("training", "held out")}
    assert len(by_role["training"]) >= 12
    assert len(by_role["held out"]) >= 6
    maps = {role: {entry.sha256 for j in junctions for entry in j.files} for role, junctions in by_role.items()}
    assert not maps["training"] & maps["held out"]
    generators = {
        role: {j.netgenerate[0] for j in junctions if j.netgenerate} | {"arms" for j in junctions if j.arms}
        for role, junctions in by_role.items()
    }
    assert not generators["training"] & generators["held out"]
    assert len(set(protocol.candidates.sensors)) == 12  # all that the catalogue had then
    assert set(protocol.candidates.sensors) <= set(CATALOGUE)
    assert not set(protocol.detectors.held_out) <= set(protocol.detectors.training)


def test_the_protocol_has_the_hash_that_was_written_down() -> None:
    text = (DOCS / "validity.md").read_text(encoding="utf-8")
    (frozen,) = re.findall(r"SHA-256 of the protocol[^`]*`([0-9a-f]{64})`", text)
    assert ProtocolFiles().digest == frozen


def test_the_shipped_detector_was_trained_as_the_command_trains_it() -> None:
    metadata = OnnxModel.load(SHIPPED_MODEL).metadata
    assert metadata["junctions"] == [junction.name for junction in detector_junctions(read_protocol())]
    assert metadata["recipe"]["steps"] == command.TRAINING_STEPS
    assert set(metadata["recipe"]["sensors"]) == set(read_protocol().candidates.sensors)


def study_table(name: str) -> table_files.Table:
    (table,) = (each for each in table_files.read(DOCS / "data" / "larger_study")[1] if each.name == name)
    return table


def test_page_has_the_ranges_over_junctions_and_detectors() -> None:
    page = (DOCS / "validity.md").read_text(encoding="utf-8")
    rows = [row for row in study_table("2 by junction").rows if row[1] == "held out" and row[4] == VARIANTS[0]]
    assert len(rows) == 6 * len(read_protocol().detectors.held_out)
    rhos, within = ([f"{pick([row[column][0] for row in rows]):.2f}" for pick in (min, max)] for column in (5, 6))
    assert f"rho {' to '.join(rhos)} by junction and detector, {' to '.join(within)} among candidates" in page
    *others, largest = sorted(row[9] for row in rows)
    assert f"{others[0]:.0f} to {math.ceil(others[-1])} points of AP, and {largest:.0f} once" in page


@pytest.mark.slow
def test_page_has_each_aim_with_its_outcome() -> None:
    page = (DOCS / "validity.md").read_text(encoding="utf-8")
    (aims,) = re.findall(r"^- \*\*\[Aims\].*$", page, re.MULTILINE)
    missed = 0
    for detector, _, _, _, what, value, _, aim, _, outcome in study_table("8 aims").rows:
        if detector not in read_protocol().detectors.held_out:
            continue  # the mean of two models
        number = f"{value[0]:.2f}" if "rho" in what else f"{value[0]:.1f}"
        assert number in aims and f" {aim:g}" in aims
        assert (f"{number}, missed" in aims) == (outcome == "missed"), (detector, what)
        missed += outcome == "missed"
    assert aims.count("missed") == missed > 0


def test_page_has_the_best_gammas_and_the_rho_of_automatic_ones() -> None:
    page = (DOCS / "validity.md").read_text(encoding="utf-8")
    by_voxel: dict[float, dict[str, dict[str, str]]] = {}
    for role, detector, voxel_m, occlusion, gamma, _, rho, _ in study_table("13 settings").rows:
        if (role, detector) == ("held out", "cluster"):
            by_voxel.setdefault(voxel_m, {}).setdefault(occlusion, {})[f"{gamma}"] = f"{rho[0]:.2f}"
    best = []
    for voxel_m, settings in by_voxel.items():
        gammas = {gamma for rhos in settings.values() for gamma, rho in rhos.items() if rho == max(rhos.values())}
        best.append(f"{' or '.join(sorted(gammas, key=float))} for {voxel_m:g} m")
    assert f"The best gamma grows with the voxels: {', '.join(best)} (" in page
    automatic = [by_voxel[voxel_m]["no"][gamma] for voxel_m, gamma in ((0.25, "2"), (0.5, "5"), (1, "10"))]
    assert f"{automatic[0]}, {automatic[1]} and {automatic[2]} here" in page


def test_every_junction_has_its_candidates_and_its_scenario() -> None:
    protocol, drawn = read_protocol(), candidates.read_candidates()
    assert list(drawn) == [junction.name for junction in protocol.measured_junctions]
    assert set(build.read_worlds()) == {junction.name for junction in protocol.junctions}
    for junction in protocol.measured_junctions:
        sites = drawn[junction.name]
        heights = list(sites.values())
        assert len(sites) == protocol.candidates.count
        assert len({site.pose.position_m[:2] for site in sites}) == len(sites)
        for height_m in protocol.heights_m(junction):
            assert heights.count(height_m) >= MIN_SITES_OF_A_HEIGHT
        for site in sites:
            assert -25.0 <= site.pose.pitch_deg <= 0.0
            assert abs(site.pose.roll_deg) <= 3.0
        sensors = [site.sensor for site in sites]
        assert {sensors.count(name) for name in protocol.candidates.sensors} == {4}


def test_candidates_stand_at_their_height_where_the_ground_is_flat() -> None:
    for site, height_m in candidates.read_candidates()["grid_left"].items():
        assert site.pose.z_m == height_m


@pytest.mark.slow
def test_no_pole_is_in_the_building_or_outside_the_surroundings(mini: Path) -> None:
    free = candidates.free_locations(build_scene(load(mini)), None, (2.0, 4.0))
    x, y = free.T
    assert not ((x > 14) & (x < 18) & (y > 5) & (y < 8)).any()
    assert x.min() == -12.0 and x.max() == 52.0 and y.min() == -22.0 and y.max() == 22.0


@pytest.mark.slow
def test_poles_are_next_to_lanes() -> None:
    scenario = load(SCENARIOS / "hill")
    roads = sumo_folder.read_network(scenario)
    assert roads is not None
    lanes = Carriageway.of(roads)
    free = candidates.free_locations(build_scene(scenario), lanes, (2.0,))
    away_m = shapely.distance(shapely.union_all(lanes.areas), shapely.points(free))
    assert len(free) > 100 and away_m.min() > 0.0 and away_m.max() <= candidates.ROAD_M


def test_scenario_with_sites_has_no_keys_of_its_former_sites(mini: Path, tmp_path: Path) -> None:
    scenario = load(mini, ["sites.yaw_deg=30"])
    expected = [Site("a", Pose(1.0, -7.0, 3.0, 5.0, -2.0, 1.0), "small"), Site("b", Pose(8.0, 7.0, 4.0), "VLP-16")]
    sites = build_scene(with_sites(scenario, expected, tmp_path / "sites.csv")).sites
    assert [(site.name, site.pose, site.sensor) for site in sites] == [
        (site.name, site.pose, site.sensor) for site in expected
    ]


def test_rejects_traffic_that_scores_would_share(mini: Path) -> None:
    with pytest.raises(InputError, match=r"traffic\.fcd: the traffic is a finished file"):
        measurement.check_unseen(load(mini))
    measurement.check_unseen(load(SCENARIOS / "hill"))


def test_models_of_the_study_were_not_trained_at_junctions_of_a_result() -> None:
    shipped = ["ingolstadt", "hill", "roundabout"]
    detector_roles = [f"detector_{name}" for name in ("grid", "queue", "left", "slope", "people")]
    for model, convention, heights_m, trained_at in (
        (SHIPPED_MODEL, "ground", [2.0, 8.0], [*shipped, *detector_roles]),
        (study_detectors.model_file(study_detectors.LOW), "ground", [2.0, 2.0], [*shipped, "east"]),
        (study_detectors.model_file(study_detectors.SENSOR), "sensor", [2.0, 2.0], [*shipped, "east"]),
    ):
        metadata = OnnxModel.load(model).metadata
        assert metadata["convention"] == convention and metadata["recipe"]["heights_m"] == heights_m
        assert metadata["junctions"] == trained_at


def test_rejects_missing_model(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(study_detectors, "model_file", lambda name: tmp_path / f"{name}.onnx")
    with pytest.raises(MissingBackendError, match=r"there is no file pointpillars_2m\.onnx"):
        study_detectors.make(study_detectors.LOW)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("frames = 120 ", "frames = 5 ", "junctions.toml: frames:"),
        ("seed = 3701", "seed = 3701\nspeed = 1", "junctions.toml: speed: unknown key"),
        ('role = "held out"', 'role = "kept"', "role:"),
        ('scenario = "hill"', 'scenario = "hill"\nnetgenerate = ["--grid"]', "expected one of scenario, netgenerate"),
        ('"VLP-16", ', '"VLP-17", ', "expected sensors of the catalogue, got 'VLP-17'"),
    ],
)
def test_rejects_invalid_protocol(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = (ProtocolFiles().folder / JUNCTIONS_FILE).read_text(encoding="utf-8")
    assert old in text
    (tmp_path / JUNCTIONS_FILE).write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_protocol(tmp_path / JUNCTIONS_FILE)
    assert message in str(caught.value)


def test_values_are_dealt_equally_often() -> None:
    dealt = candidates.dealt(("a", "b", "c"), 48, np.random.default_rng(1))
    assert [dealt.count(value) for value in "abc"] == [16, 16, 16]
    assert dealt != sorted(dealt)
    some = candidates.dealt(("a", "b", "c"), 8, np.random.default_rng(2))
    assert sorted(some.count(value) for value in "abc") == [2, 3, 3]


def test_terrain_by_hand() -> None:
    terrain = Terrain(
        amplitude_m=(4.0, 1.0), wavelength_m=(100.0, 40.0), bearing_deg=(0.0, 90.0), phase_deg=(0.0, 90.0)
    )
    assert terrain.height_m(25.0, 0.0) == pytest.approx(4.0 + 1.0)
    assert terrain.height_m(75.0, 20.0) == pytest.approx(-4.0 - 1.0)


def test_map_files_are_identified_by_name_and_hash(tmp_path: Path) -> None:
    (tmp_path / "map.osm").write_bytes(b"roads")
    digest = "0ca5ab3a34d3cde2f4d63b8f1fd5d1a3d4e7ce1f0b3b6ae2a7a8a4ac9c5cbd3e"
    with pytest.raises(worlds.MissingMapError, match="expected the SHA-256"):
        worlds.find_map(MapFile(name="map.osm", sha256=digest), tmp_path)
    with pytest.raises(worlds.MissingMapError, match=r"there is no file other\.osm"):
        worlds.find_map(MapFile(name="other.osm", sha256=digest), tmp_path)
    with pytest.raises(worlds.MissingMapError, match=r"map\.osm is needed"):
        worlds.find_map(MapFile(name="map.osm", sha256=digest), None)


def test_furniture_is_next_to_roads_without_overlaps() -> None:
    scenario = load(SCENARIOS / "roundabout")
    roads = sumo_folder.read_network(scenario)
    assert roads is not None
    config = Furniture(poles=6, trees=3, kiosks=2, buildings=2)
    drawn = furniture.draw(config, roads, scenario.roi, (1, 2))
    assert drawn == furniture.draw(config, roads, scenario.roi, (1, 2))
    assert drawn != furniture.draw(config, roads, scenario.roi, (1, 3))
    kinds = [feature["properties"]["kind"] for feature in drawn["features"]]
    assert {kind: kinds.count(kind) for kind in kinds} == {
        "building": 2, "kiosk": 2, "tree_trunk": 3, "tree_crown": 3, "pole": 6,
    }  # fmt: skip
    carriageway = shapely.union_all(Carriageway.of(roads).areas)
    for feature in drawn["features"]:
        if feature["properties"]["kind"] != "tree_crown":
            shape = shapely.geometry.shape(feature["geometry"]).buffer(feature["properties"].get("radius_m", 0.0))
            assert carriageway.distance(shape) > 0.5


def test_vehicles_are_dense_up_to_the_gap() -> None:
    boxes = np.array([[0.0, 0.0, 1.0, 4.0, 2.0, 1.5, 0.0], [5.5, 0.0, 1.0, 4.0, 2.0, 1.5, 0.0],
                      [20.0, 0.0, 1.0, 4.0, 2.0, 1.5, 0.0], [24.1, 0.0, 1.0, 4.0, 2.0, 1.5, 0.0]])  # fmt: skip
    frame = TrafficFrame(0, ("a", "b", "c", "c"), ("passenger",) * 4, boxes, np.zeros(4))
    # a and b: 5.5 - 4 = 1.5 m apart; the two boxes named c are parts of one vehicle
    assert build.is_dense(frame, np.array([0, 1, 2])).tolist() == [True, True, False]
    assert build.is_dense(frame, np.array([], dtype=np.int64)).tolist() == []


def test_the_hash_of_a_scenario_is_that_of_its_contents(tmp_path: Path) -> None:
    folder = tmp_path / "roundabout"
    shutil.copytree(SCENARIOS / "roundabout", folder)
    digest = build.world_digest(folder)
    assert digest == build.world_digest(SCENARIOS / "roundabout") == build.read_worlds()["roundabout"]
    with (folder / "scenario.toml").open("a", encoding="utf-8") as file:
        file.write("# a comment\n")
    assert build.world_digest(folder) == digest
    statics = folder / "statics.geojson"
    text = statics.read_text(encoding="utf-8").replace('"height_m": 16', '"height_m": 17', 1)
    statics.write_text(text, encoding="utf-8")
    assert build.world_digest(folder) != digest


# ---- statistics, by hand


def rows(*values: float) -> np.ndarray:
    return np.array([values], dtype=np.float64)


def test_rho_by_hand() -> None:
    # ranks 1 2 3 4 and 1 3 2 4: 1 - 6 * 2 / (4 * 15)
    assert statistics.rho(rows(1, 2, 3, 4), rows(10, 30, 20, 40))[0] == pytest.approx(0.8)


def test_regret_by_hand() -> None:
    ap = rows(0.5, 0.7, 0.6)
    assert statistics.regret(rows(1, 3, 2), ap)[0] == 0.0
    assert statistics.regret(rows(1, 2, 3), ap)[0] == pytest.approx(10.0)
    assert statistics.regret(rows(3, 2, 3), ap)[0] == pytest.approx(15.0)  # the mean of 20 and 10


def test_crossed_regret_by_hand() -> None:
    halves = np.array([[0.5, 0.4], [0.7, 0.5], [0.6, 0.8]])
    # the score takes the first; half 1 chooses the second (0.5 - 0.4 in half 2), half 2 the third (0.6 - 0.5 in half 1)
    assert statistics.crossed_regret(np.array([3.0, 1.0, 2.0]), halves) == pytest.approx(10.0)
    # taking the best of one half loses nothing there, and less than nothing in the other
    assert statistics.crossed_regret(np.array([1.0, 3.0, 2.0]), halves) == pytest.approx(-5.0)


def test_rho_given_groups_by_hand() -> None:
    # both have the order 1 2 in one group and 3 4 in the other, and then opposite orders within both
    groups = [np.array([[0, 0, 1, 1]])]
    explained = statistics.projections(groups)
    assert statistics.rho_given(rows(1, 2, 3, 4), rows(10, 20, 30, 40), explained)[0] == pytest.approx(1.0)
    assert statistics.rho_given(rows(2, 1, 4, 3), rows(10, 20, 30, 40), explained)[0] == pytest.approx(-1.0)
    assert np.isnan(statistics.rho_given(rows(1, 1, 2, 2), rows(10, 20, 30, 40), explained)[0])


def test_rho_given_groups_is_the_correlation_of_least_squares_residuals() -> None:
    rng = np.random.default_rng(3)
    first, second = rng.integers(0, 4, 30), rng.integers(0, 3, 30)
    x, y = rng.normal(size=(2, 30)) + first
    effects = np.column_stack([first[:, None] == np.arange(4), second[:, None] == np.arange(3)]).astype(float)
    residuals = []
    for values in (x, y):
        ranks = np.argsort(np.argsort(values)) + 1.0
        residuals.append(ranks - effects @ np.linalg.lstsq(effects, ranks, rcond=None)[0])
    explained = statistics.projections([first[None, :], second[None, :]])
    value = statistics.rho_given(x[None, :], y[None, :], explained)[0]
    assert value == pytest.approx(np.corrcoef(*residuals)[0, 1])


def test_equal_values_limit_rho() -> None:
    # three of five are equal: ranks 2 2 2 4 5 against 1 2 3 4 5
    ap = np.array([0.0, 0.0, 0.0, 0.4, 0.5])
    assert statistics.tie_factor(ap) == pytest.approx(np.sqrt(1 - 24 / 120))
    assert statistics.rho(rows(1, 2, 3, 4, 5), ap[None, :])[0] == pytest.approx(statistics.tie_factor(ap))


def test_undefined_scores_are_taken_last() -> None:
    ap = np.arange(8.0) / 10
    score = np.array([1.0, 2, 3, 4, 5, 6, 7, np.nan])
    junction = detected(ap, score)
    assert junction.regret("s").value == pytest.approx(10.0)
    assert junction.crossed_regret("s") == pytest.approx(10.0)
    assert junction.best_in_first("s") == 0.0
    assert junction.by_group("s", np.full(8, 2.0), 8)["2"].count == 7
    assert np.isnan(junction.by_group("s", np.full(8, 2.0), 8)["2"].value)


def test_groups_of_equal_size_draw_their_own_candidates() -> None:
    rng = np.random.default_rng(5)
    ap = np.tile(rng.random(16), 2)
    score = np.tile(rng.random(16), 2)
    each = detected(ap, score).by_group("s", np.repeat([2.0, 4.0], 16), 16)
    assert each["2"].value == pytest.approx(each["4"].value)
    assert not np.allclose(each["2"].resampled, each["4"].resampled)


def test_the_first_three_by_hand() -> None:
    ap = rows(0.1, 0.2, 0.9, 0.3, 0.4)
    assert statistics.in_first(rows(1, 2, 3, 4, 5), ap)[0] == 1.0
    assert statistics.in_first(rows(1, 2, 0, 4, 5), ap)[0] == 0.0
    # two are higher, and three share the third score: a chance of 1 in 3
    assert statistics.in_first(rows(1, 1, 1, 4, 5), ap)[0] == pytest.approx(1 / 3)


def test_spearman_brown_by_hand() -> None:
    assert statistics.spearman_brown(np.array([0.5]))[0] == pytest.approx(2 / 3)
    assert statistics.spearman_brown(np.array([1.0]))[0] == 1.0


def detected(
    ap: np.ndarray, score: np.ndarray, *, halves: np.ndarray | None = None, noise: np.ndarray | None = None,
    heights: np.ndarray | None = None, name: str = "j", resamples: int = 200,
) -> DetectedJunction:  # fmt: skip
    """Return a junction; without noise every block gives the same AP."""
    n = len(ap)
    left_out = np.repeat(ap[:, None], 10, axis=1) if noise is None else noise
    return DetectedJunction(
        name, MeasureValues(ap, left_out), np.column_stack([ap, ap]) if halves is None else halves, {"s": score},
        np.full(n, 2.0) if heights is None else heights, np.full(n, "VLP-16"), resamples,
    )  # fmt: skip


def test_reliability_and_ceiling_by_hand() -> None:
    ap = np.array([0.1, 0.2, 0.3, 0.4])
    halves = np.column_stack([[1.0, 2.0, 3.0, 4.0], [1.0, 3.0, 2.0, 4.0]])  # rho 0.8
    junction = detected(ap, ap, halves=halves)
    assert junction.reliability() == pytest.approx(1.6 / 1.8)
    assert junction.ceiling() == pytest.approx(np.sqrt(1.6 / 1.8))
    opposite = detected(ap, ap, halves=np.column_stack([ap, -ap]))
    assert np.isnan(opposite.reliability())


def test_rho_within_groups_by_hand() -> None:
    # within each height the order is right in one and wrong in the other; five and ten candidates
    ap = np.arange(15.0) / 100
    score = np.concatenate([-np.arange(5.0), 100.0 + np.arange(10.0)])
    heights = np.array([2.0] * 5 + [4.0] * 10)
    junction = detected(ap, score, heights=heights)
    each = junction.by_group("s", heights, 5)
    assert {name: estimate.value for name, estimate in each.items()} == pytest.approx({"2": -1.0, "4": 1.0})
    assert junction.in_groups("s", heights, 5).value == pytest.approx((5 * -1.0 + 10 * 1.0) / 15)
    assert junction.in_groups("s", heights, 6).value == pytest.approx(1.0)
    assert np.isnan(junction.in_groups("s", heights, 11).value)


def test_groups_that_are_undefined_in_a_resample_are_left_out_of_it() -> None:
    mean = statistics._weighted_mean(np.array([[1.0, np.nan], [0.0, 0.5]]), np.array([3.0, 1.0]))
    assert mean.tolist() == [0.75, 0.5]


def test_junctions_are_resampled() -> None:
    each = {name: Estimate(value, np.full(1000, value), 9) for name, value in zip("abc", (1.0, 0.0, 0.0), strict=True)}
    mean = statistics.over_junctions(each)
    assert mean.value == pytest.approx(1 / 3)
    # a is drawn 0, 1, 2 or 3 times of 3
    values, counts = np.unique(np.round(mean.resampled, 3), return_counts=True)
    assert values.tolist() == [0.0, 0.333, 0.667, 1.0]
    assert (counts / 1000).tolist() == pytest.approx([8 / 27, 12 / 27, 6 / 27, 1 / 27], abs=0.05)
    two = statistics.over_junctions({"a": each["a"], "b": each["b"]})
    assert (two.value, len(two.resampled)) == (0.5, 0)
    undefined = statistics.over_junctions({"c": Estimate(float("nan"), np.empty(0), 0)})
    assert np.isnan(undefined.value)


def test_noise_that_lowers_every_resample_does_not_move_the_middle() -> None:
    lowered = {name: Estimate(0.8, np.linspace(0.5, 0.7, 1001), 9) for name in "abcd"}
    assert np.median(statistics.over_junctions(lowered).resampled) == pytest.approx(0.8, abs=0.01)


def synthetic(rng: np.random.Generator, name: str, junction_spread: float) -> DetectedJunction:
    """Return a junction whose score follows the true AP with noise that differs from junction to junction."""
    n, blocks = 40, 10
    true = rng.normal(size=n)
    score = true + rng.normal(size=n) * np.exp(junction_spread * rng.normal()) * 0.5
    of_block = true[:, None] + rng.normal(size=(n, blocks)) * 0.9
    ap = of_block.mean(axis=1)
    left_out = (blocks * ap[:, None] - of_block) / (blocks - 1)
    return detected(ap, score, noise=left_out, name=name, resamples=200)


@pytest.mark.slow
@pytest.mark.parametrize(("spread", "least", "most"), [(0.0, 0.92, 1.0), (1.2, 0.80, 0.97)])
def test_intervals_over_junctions_contain_the_truth(spread: float, least: float, most: float) -> None:
    """Six junctions that are alike, or differ much; 100 studies. The truth is the mean of 2,000 other junctions."""
    rng = np.random.default_rng(7)
    others = [synthetic(rng, "other", spread) for _ in range(2000)]
    truth = np.mean([statistics.rho(o.scores["s"][None, :], o.ap.values[None, :])[0] for o in others])
    inside = []
    for study in range(100):
        each = {}
        for number in range(6):
            name = f"s{study}j{number}"
            each[name] = synthetic(rng, name, spread).rho("s")
        interval = statistics.over_junctions(each).interval
        inside.append(interval.low <= truth <= interval.high)
    print(f"coverage with a spread of {spread}: {np.mean(inside):.2f}")
    assert least <= np.mean(inside) <= most


# ---- records and tables


MACHINE = {"processor": "p", "cores": 2}

VARIANTS = [f"expected_detections (detectors {names})" for names in ("cluster+pointpillars", "cluster", "pointpillars")]


def _settings(part: str) -> str:
    return "" if part in records.NOT_DETECTORS else detections.settings_digest(part)


def write_junction(
    folder: Path,
    name: str,
    role: str,
    ap: np.ndarray,
    score: np.ndarray,
    height_m: np.ndarray,
    detector: str = "cluster",
) -> None:
    """Write records without noise: every block and half has the same AP."""
    sites = [f"c{i}" for i in range(len(ap))]
    write_table(folder / f"{name}.candidates.parquet", {
        "site": sites, "sensor": ["VLP-16"] * len(ap), "height_m": height_m.tolist(),
    })  # fmt: skip
    names = [*VARIANTS, "points_on_target", tables.EGVS_2, tables.EGVS_10, "mean_points", "less_is_better"]
    write_table(folder / f"{name}.scores.parquet", {
        "site": sites * len(names),
        "score": np.repeat(names, len(ap)).tolist(),
        "sign": np.repeat([1] * (len(names) - 1) + [-1], len(ap)).tolist(),
        "value": np.tile(score, len(names)).tolist(),
    })  # fmt: skip
    values = np.tile(ap, len(MEASURES))
    write_table(folder / f"{name}.{detector}.parquet", {
        "site": sites * len(MEASURES), "measure": np.repeat(MEASURES, len(ap)).tolist(), "value": values.tolist(),
        "left_out": [np.full(10, value) for value in values],
        "half_1": values.tolist(), "half_2": values.tolist(),
    })  # fmt: skip
    for part in ("scores", detector):
        PartInfo(name, role, part, "k", "s", _settings(part), "p", 120, 7.0, 50, 900, len(ap), {"TPOG": 1, "unseen": 2},
                 False, 60.0, 50.0, 2.0 if part == detector else 0.0, MACHINE).write(folder)  # fmt: skip


@pytest.fixture
def made_up(tmp_path: Path) -> Path:
    """Two heights of 16 candidates each. In h, the score has the right order within each height only."""
    folder = tmp_path / "records"
    folder.mkdir()
    height_m = np.repeat([2.0, 5.0], 16)
    ap = np.concatenate([np.arange(17, 33), np.arange(1, 17)]) / 100
    score = np.arange(1.0, 33.0)
    write_junction(folder, "t", "training", ap, ap, height_m)
    write_junction(folder, "h", "held out", ap, score, height_m)
    return folder


def write_tables(folder: Path, out: Path) -> list[str]:
    return tables.write_tables(folder, out, read_protocol(), "p", resamples=200)


@pytest.mark.slow
def test_tables_by_hand(made_up: Path, tmp_path: Path) -> None:
    printed = write_tables(made_up, tmp_path / "out")
    assert printed[0].startswith("2 junctions, detectors cluster; 4 parts, 0.07 hours on p, 2 cores")
    _, made = table_files.read(tmp_path / "out")
    by_name = {table.name: table for table in made}
    rows_of: dict[tuple[Any, Any], list[Any]] = {(row[0], row[4]): row for row in by_name["2 by junction"].rows}
    right, wrong = rows_of["t", VARIANTS[0]], rows_of["h", VARIANTS[0]]
    assert right[5][0] == right[6][0] == 1.0
    # all 32 ranks differ by 16: 1 - 6 * 32 * 256 / (32 * 1023)
    assert wrong[5][0] == pytest.approx(1 - 6 * 256 / 1023, abs=1e-4)
    assert wrong[6][0] == 1.0
    assert wrong[9:11] == [16.0, 16.0]  # 0.32 is the best, 0.16 is taken; both halves agree
    assert (right[11:], wrong[11:]) == ([1.0, 1.0], [0.0, 0.0])
    # there is one sensor, and within heights the score is right
    assert wrong[8][0] == pytest.approx(1.0)
    # lower was better at the training junction, so height alone has the order of the two heights: ties within each
    height = rows_of["h", "height"]
    assert height[5][0] == pytest.approx(np.sqrt(0.75 * 1024 / 1023), abs=1e-3)
    assert height[9] == pytest.approx(7.5)  # 0.32 minus the mean of 0.17 to 0.32
    (measured,) = [row for row in by_name["1 measured"].rows if row[0] == "h"]
    assert measured[8:] == [0, 1.0, 16.5, 32.0, 0.0, 1.0, 1.0, 1.0]
    _, aim_of_height, median, worst, level, _ = by_name["8 aims"].rows
    # one junction has no interval
    assert aim_of_height[4:] == ["mean rho within heights", [1.0, None, None], None, 0.85, 0.85, "undecided"]
    assert median[4:] == ["median regret", [16.0, None, None], 16.0, 3.0, 3.0, "undecided"]
    assert worst[4:] == ["worst regret", [16.0, None, None], 16.0, 8.0, 8.0, "undecided"]
    # the upper half are 17 to 32 by a score that is 100 times a share; recall is AP here, 1 to 16 of 100
    error = 100.0 * np.arange(17, 33) - np.arange(1, 17)
    rms = round(float(np.sqrt((error**2).mean())), 4)
    assert level[4:] == ["mean error of the level", [rms, None, None], rms, 5.0, 5.0, "undecided"]
    aims = {(row[0], row[3]): row[4:] for row in by_name["9 aims by junction"].rows}
    assert aims["h", "rho"][1:] == [0.93, "no"]
    assert aims["h", "rho at 2 m"] == [1.0, 0.85, "yes"]
    less = {(row[0], row[3]): row[5:] for row in by_name["4 differences"].rows}
    assert less["held out", "points_on_target"] == [[0.0, None, None]] * 5
    assert less["held out", "height"][4][0] == pytest.approx(16.0 - 7.5)
    assert ("training", "height") not in less  # there is no other training junction to fit it to
    everything = {(row[0], row[2]): row[4] for row in by_name["7 all scores"].rows}
    assert everything["training", "less_is_better"] == -1.0
    settings = [row[2:6] for row in by_name["13 settings"].rows if row[0] == "held out"]
    assert settings == [[0.25, "no", "2", 1], [0.25, "no", "10", 1]]  # those of the records
    rhos = {(row[0], row[4]): [rho[0] for rho in row[6:]] for row in by_name["13 settings"].rows}
    assert rhos["held out", "2"] == [rho[0] for rho in rows_of["h", tables.EGVS_2][5:7]]
    assert rhos["training", "10"] == [1.0, 1.0]


@pytest.mark.slow
def test_aims_are_decided_when_all_held_out_junctions_are_there(made_up: Path, tmp_path: Path) -> None:
    protocol = read_protocol()
    (first, *_) = (junction for junction in protocol.junctions if junction.role == "held out")
    small = protocol.model_copy(update={"junctions": (first.model_copy(update={"name": "h"}),)})
    tables.write_tables(made_up, tmp_path / "out", small, "p", resamples=200)
    _, made = table_files.read(tmp_path / "out")
    (aims,) = [table for table in made if table.name == "8 aims"]
    # one junction has no interval of rho; the losses are far too high, with and without noise
    assert [row[-1] for row in aims.rows] == ["undecided"] * 2 + ["missed"] * 4


def test_level_by_hand() -> None:
    found = np.array([84.0, 48.0, 25.0, 80.0, 3.0])
    level = calibration.Level("s", np.array([90.0, 50.0, 20.0, 90.0, 3.0]), found, np.full(5, 2.0), 8.0)
    assert level.error.tolist() == [6.0, 2.0, -5.0, 10.0, 0.0]
    assert level.upper_half.tolist() == [0, 3, 1]
    assert level.rms_error == pytest.approx(np.sqrt((36 + 100 + 4) / 3))
    assert level.corrected_rms_error == pytest.approx(np.sqrt((36 + 100 + 4) / 3 - 4))
    nothing = calibration.Level("s", *np.empty((3, 0)), np.nan)
    assert np.isnan([nothing.rms_error, nothing.corrected_rms_error]).all()


def test_level_is_that_of_the_detectors_own_model(tmp_path: Path) -> None:
    ap = np.array([0.2, 0.4, np.nan])
    for detector, found in (("cluster", ap), ("pointpillars", ap / 2), ("range_image", ap / 4)):
        write_junction(tmp_path, "h", "held out", found, np.array([0.3, 0.4, 0.9]), np.ones(3), detector)
    record = records.read_junction(tmp_path, "h")
    own = calibration.level(record, ["cluster"], VARIANTS[0])
    assert (own.score, own.found.tolist(), own.expected.tolist()) == (VARIANTS[1], [20.0, 40.0], [30.0, 40.0])
    assert own.first_error == pytest.approx(0.0)
    together = calibration.level(record, ["cluster", "pointpillars"], VARIANTS[0])
    assert (together.score, together.found.tolist()) == (VARIANTS[0], [15.0, 30.0])
    assert calibration.level(record, ["range_image"], VARIANTS[0]).score == VARIANTS[0]
    lacking = replace(record, scores={VARIANTS[0]: record.scores[VARIANTS[0]]})
    with pytest.raises(InputError, match=r"no expected_detections \(detectors cluster\)"):
        calibration.level(lacking, ["cluster"], VARIANTS[0])


@pytest.mark.slow
@pytest.mark.system  # draws with matplotlib
def test_reliability_of_made_up_vehicles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def changed() -> None:
        raise InputError("frozen.json", "score changed since they were frozen")

    monkeypatch.setattr(tables, "check_frozen", changed)
    folder = tmp_path / "records"
    folder.mkdir()
    write_rows(folder, "h", ("cluster", "range_image"), np.random.default_rng(12), role="held out")
    printed = write_tables(folder, tmp_path / "out")
    assert any(text.startswith("NOT AS FROZEN: ") for text in printed)
    assert printed[-2:] == [str(tmp_path / "out" / f"reliability_{name}.png") for name in ("cluster", "range_image")]
    _, made = table_files.read(tmp_path / "out")
    (table,) = [table for table in made if table.name == "11 reliability"]
    record = records.read_junction(folder, "h")
    sites = vehicle_rows.read_rows(folder, record, "range_image")
    seen = np.concatenate([site.has_points for site in sites])
    chances = np.concatenate([site.shipped for site in sites])[seen]
    hits = np.concatenate([site.hits for site in sites])[seen]
    columns = sites[3].features.columns
    features = np.column_stack([columns[name] for name in FEATURES])
    each = [uncorrected_model(name).chances(features) for name in DETECTORS]
    np.testing.assert_allclose(sites[3].shipped, np.where(columns["log_points"] > 0.0, np.mean(each, axis=0), 0.0))
    for _, _, chance, found, count in [row for row in table.rows if row[1] == "range_image"]:
        members = np.floor(np.minimum(chances, 0.999) * 10) == np.floor(min(chance, 0.999) * 10)
        assert (members.sum(), hits[members].mean()) == (count, pytest.approx(found, abs=1e-4))
        assert chances[members].mean() == pytest.approx(chance, abs=1e-4)


@pytest.mark.slow
def test_tables_say_what_is_missing(made_up: Path, tmp_path: Path) -> None:
    info = PartInfo.read(made_up / "h.cluster.json")
    PartInfo(**{**vars(info), "again": ("a fault in the cable",), "skipped": ("nuc: no lanes",)}).write(made_up)
    printed = write_tables(made_up, tmp_path / "out")
    assert "INCOMPLETE: town01 was not measured." in printed
    assert "h cluster was measured again: a fault in the cable" in printed
    assert "h: skipped nuc: no lanes" in printed


@pytest.mark.parametrize(
    ("low", "high", "outcome"), [(0.93, 0.99, "reached"), (0.90, 0.929, "missed"), (0.90, 0.99, "undecided")]
)
def test_outcomes_of_rho(low: float, high: float, outcome: str) -> None:
    estimate = Estimate((low + high) / 2, np.linspace(low, high, 4001), 6)
    span = estimate.interval
    limit = {"reached": span.low, "missed": span.high + 1e-6, "undecided": (span.low + span.high) / 2}[outcome]
    assert tables._outcome_of_rho(estimate, limit) == outcome


def test_outcomes_of_losses() -> None:
    assert tables._outcome_of_loss(2.9, -1.0, 3.0) == "reached"
    assert tables._outcome_of_loss(4.0, 2.0, 3.0) == "undecided"
    assert tables._outcome_of_loss(4.0, 3.5, 3.0) == "missed"
    assert tables._outcome_of_loss(float("nan"), float("nan"), 3.0) == "undecided"


def test_orders_by_sensor_and_height_are_those_of_the_training_junctions() -> None:
    """Two sensors at two heights: the second sensor is better by two ranks, the higher site by one."""

    def record(name: str, role: str, ap: list[float], detector: str) -> records.JunctionRecord:
        values = np.array(ap)
        measure = records.MeasureRecord(values, np.repeat(values[:, None], 10, axis=1), np.column_stack([values] * 2))
        return records.JunctionRecord(
            name, role, ("a", "b", "c", "d"), np.array([2.0, 4.0, 2.0, 4.0]), ("X", "X", "Y", "Y"), {},
            {detector: {AP: measure}}, {},
        )  # fmt: skip

    training = record("t", "training", [0.1, 0.2, 0.3, 0.4], "one")
    tested = record("h", "held out", [0.4, 0.3, 0.2, 0.1], "two")
    baselines = tables.TrainedBaselines([training, tested], ["one", "two"])
    for detector in ("one", "two"):  # the second was not run at the training junction
        values = baselines.of(tested, detector)
        assert values["sensor"] == pytest.approx([0.25, 0.25, 0.75, 0.75])
        assert values["sensor and height"] == pytest.approx([0.125, 0.375, 0.625, 0.875])
        assert values["height"][1] - values["height"][0] == pytest.approx(0.25)
    assert tables.TrainedBaselines([tested], ["two"]).of(tested, "two") == {}
    # a training junction gets what the others say
    other = record("u", "training", [0.4, 0.3, 0.2, 0.1], "one")
    baselines = tables.TrainedBaselines([training, other], ["one"])
    assert baselines.of(training, "one")["sensor"] == pytest.approx([0.75, 0.75, 0.25, 0.25])
    assert tables.TrainedBaselines([training], ["one"]).of(training, "one") == {}


@pytest.mark.slow
def test_tables_are_the_same_each_time(made_up: Path, tmp_path: Path) -> None:
    write_tables(made_up, tmp_path / "one")
    write_tables(made_up, tmp_path / "two")
    for path in sorted((tmp_path / "one").iterdir()):
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


@pytest.mark.slow
def test_tables_name_a_trial_and_several_sources(made_up: Path, tmp_path: Path) -> None:
    info = PartInfo.read(made_up / "h.cluster.json")
    PartInfo(**{**vars(info), "source": "other", "is_trial": True}).write(made_up)
    printed = " ".join(write_tables(made_up, tmp_path / "out"))
    assert "No result" in printed
    assert "Parts cluster were measured with 2 versions of the source" in printed


def test_rejects_damaged_record(made_up: Path, tmp_path: Path) -> None:
    (made_up / "h.cluster.parquet").write_bytes(b"PAR1")
    with pytest.raises(InputError, match=r"h\.cluster\.parquet"):
        write_tables(made_up, tmp_path / "out")
    (made_up / "h.cluster.json").write_text("{}", encoding="utf-8")
    with pytest.raises(InputError, match=r"h\.cluster\.json"):
        write_tables(made_up, tmp_path / "out")
    with pytest.raises(InputError, match="expected records, got none"):
        write_tables(tmp_path / "nowhere", tmp_path / "out")


def write_rows(
    folder: Path, name: str, detectors: tuple[str, ...], rng: np.random.Generator, role: str = "training"
) -> None:
    """Write records where detectors find a vehicle the more probably the more points it has; four per candidate."""
    sites, count = 32, 50
    site = np.repeat([f"c{i}" for i in range(sites)], count)
    row = np.tile(np.arange(count), sites)
    log_points = rng.uniform(0.0, 6.0, sites * count) * np.repeat(np.linspace(0.3, 1.0, sites), count)
    columns = {feature: rng.uniform(0.0, 1.0, sites * count).astype(np.float32) for feature in DIRECTIONS}
    columns["log_points"] = log_points.astype(np.float32)
    write_table(folder / f"{name}.features.parquet", {
        "site": site, "row": row, "vehicle_class": np.zeros(len(row), np.int8), **columns,
    })  # fmt: skip
    hits = (rng.random(len(row)) < log_points / 6.0).astype(np.float32)
    share = hits.reshape(sites, count).mean(axis=1)
    for detector in detectors:
        write_junction(folder, name, role, share, share, np.repeat([2.0, 5.0], sites // 2), detector)
        scored = PartInfo.read(folder / f"{name}.scores.json")
        PartInfo(**{**vars(scored), "part": VEHICLES}).write(folder)
        write_table(folder / f"{name}.{detector}.hits.parquet", {"site": site, "row": row, "hits": hits})


@pytest.mark.slow
@pytest.mark.system  # scikit-learn asks the system for its cores
def test_models_are_fitted_to_training_records(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, detectors = tmp_path / "records", (*read_protocol().detectors.training, study_detectors.SENSOR)
    folder.mkdir()
    rng = np.random.default_rng(11)
    for name in ("hill", "xian", "town01"):  # the last is held out
        write_rows(folder, name, detectors, rng)
        for part in detectors:
            info = PartInfo.read(folder / f"{name}.{part}.json")
            replace(info, protocol=ProtocolFiles().digest).write(folder)
    write = ["fit", "--data", str(tmp_path), "--write", str(tmp_path / "models.json")]
    assert command.main(write) == 2
    assert "roundabout" in (text := capsys.readouterr().err) and "not measured with cluster" in text
    assert command.main([*write, "--without", "hill"]) == 2
    assert "the shipped models are of all" in capsys.readouterr().err
    of_two = [junction for junction in read_protocol().junctions if junction.name in ("hill", "xian", "town01")]
    small = read_protocol().model_copy(update={"junctions": tuple(of_two)})
    monkeypatch.setattr(command, "read_protocol", lambda: small)
    by_junction = training.read_training(folder, read_protocol(), "cluster")
    assert list(by_junction) == ["hill", "xian"]
    assert [site.group for site in by_junction["hill"]] == ["2 m"] * 16 + ["5 m"] * 16
    assert command.main([*write, "--figure", str(tmp_path / "its.png")]) == 0
    assert (tmp_path / "its.png").read_bytes().startswith(b"\x89PNG")
    content = json.loads((tmp_path / "models.json").read_text(encoding="utf-8"))
    assert list(content["about"]["learnt_on"]) == ["hill", "xian"]
    assert tuple(content["detectors"]) == MODELLED
    model = DetectabilityModel.of(content["detectors"]["cluster"])
    few, many = np.full((2, len(FEATURES)), 0.5)
    few[FEATURES.index("log_points")], many[FEATURES.index("log_points")] = 0.5, 4.0
    few_chance, many_chance = model.chances(np.array([few, many])).tolist()
    assert (few_chance, many_chance) == pytest.approx((0.5 / 6, 4.0 / 6), abs=0.2)
    info = PartInfo.read(folder / "hill.cluster.json")
    replace(info, vehicles=51).write(folder)
    with pytest.raises(InputError, match=r"hill\.features\.parquet: its rows are not those"):  # of other traffic
        training.read_training(folder, read_protocol(), "cluster")
    for other in (
        replace(info, settings="of another version"),
        replace(info, protocol="p"),
        replace(info, is_trial=True),
    ):
        other.write(folder)
        with pytest.raises(InputError, match=r"hill\.cluster\.json: expected cluster as it is installed"):
            training.read_training(folder, read_protocol(), "cluster")
    info.write(folder)
    features = records.read_table(folder / "hill.features.parquet").to_pydict()
    write_table(folder / "hill.features.parquet", {name: features[name] for name in features if name != "side"})
    with pytest.raises(
        InputError, match=r"hill\.features\.parquet: has no column side\. Measure the part vehicles again"
    ):
        training.read_training(folder, read_protocol(), "cluster")
    write_table(folder / "hill.features.parquet", features)
    damaged = records.read_table(folder / "hill.cluster.hits.parquet").slice(1)
    write_table(folder / "hill.cluster.hits.parquet", damaged.to_pydict())
    with pytest.raises(InputError, match=r"hill\.features\.parquet: its rows are not those"):
        training.read_training(folder, read_protocol(), "cluster")
    (folder / "hill.cluster.json").unlink()
    with pytest.raises(InputError, match="expected 2 training junctions with cluster, got xian"):
        training.read_training(folder, read_protocol(), "cluster")


def test_undefined_values_survive_a_file(tmp_path: Path) -> None:
    write_junction(tmp_path, "n", "training", np.array([0.1, np.nan, 0.3]), np.ones(3), np.ones(3))
    record = records.read_junction(tmp_path, "n")
    assert np.isnan(record.detections["cluster"][AP].values).tolist() == [False, True, False]
    assert record.detections["cluster"][AP].left_out.shape == (3, 10)
    assert record.scores["less_is_better"].tolist() == [-1.0] * 3


def test_halves_of_the_frames_are_alternate_blocks() -> None:
    first, second = detections.half_frames(20)
    assert first == [0, 1, 4, 5, 8, 9, 12, 13, 16, 17]
    assert second == [2, 3, 6, 7, 10, 11, 14, 15, 18, 19]


def test_hours_by_hand() -> None:
    protocol = read_protocol()
    info = PartInfo("j", "training", "cluster", "", "", "", "", 20, 7.0, 1, 1, 8, {}, True, 9.0, 8.0, 0.5, MACHINE)
    frames = [protocol.frames_of(junction) for junction in protocol.measured_junctions]
    assert sorted(frames) == [60] * 12 + [120] * 6 + [320]
    assert costs.estimated_s([info], protocol) == {"cluster": pytest.approx(48 * 6 * 0.5 + 40)}  # 48 sites, 120 frames
    text = costs.estimate([info], protocol)
    assert "about 0.4 hours" in text  # 184 s times 12 / 2 + 6 + 320 / 120, on two cores
    assert "without pointpillars" in text


# ---- the command


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["measure", "--junction", "nowhere"], "--junction: expected a junction of the study, got 'nowhere'"),
        (["measure", "--junction", "town01"], "--junction: town01 is held out, and can be measured only once"),
        (
            ["measure", "--junction", "town01", "--held-out", "--frames", "20"],
            "a trial at town01 would spend a junction",
        ),
        (["measure", "--junction", "nishishinjuku", "--candidates", "4"], "a trial at nishishinjuku would spend"),
        (["measure", "--junction", "hill", "--frames", "10"], "--frames, --candidates: expected 20 to"),
        (["measure", "--junction", "hill", "--part", "eyes"], "--part: expected some of scores, vehicles, cluster"),
    ],
)
def test_rejects_measurements_that_would_spend_held_out_junctions(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command.main([*arguments, "--data", str(tmp_path / "study")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "study").exists()


@pytest.mark.slow
def test_held_out_junctions_need_what_is_tested_to_be_frozen(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="are not frozen yet"):
        check_frozen(tmp_path)
    path = write_frozen(tmp_path / "records", tmp_path)
    check_frozen(tmp_path)
    frozen = json.loads(path.read_text(encoding="utf-8"))
    assert {
        "score",
        "cluster",
        "pointpillars",
        "range_image",
        "egvs.extensions.validation.correlation",
        "benchmarks.across_junctions.tables",
    } <= frozen.keys()
    path.write_text(json.dumps(frozen | {"score": "another", "cluster": "another"}), encoding="utf-8")
    with pytest.raises(InputError, match="cluster, score changed since they were frozen"):
        check_frozen(tmp_path)
    (tmp_path / "records").mkdir()
    (tmp_path / "records" / "town01.cluster.json").touch()
    with pytest.raises(InputError, match="town01 measured already"):
        write_frozen(tmp_path / "records", tmp_path)
    write_frozen(tmp_path / "records", tmp_path, again="a fault in the cable")
    check_frozen(tmp_path)
    write_frozen(tmp_path / "records", tmp_path, again="another one")
    assert frozen_again(tmp_path) == ["a fault in the cable", "another one"]
    first, second = json.loads(path.read_text(encoding="utf-8"))["frozen again"]
    changed = {row["name"]: (row["hash"], row["new name"], row["new hash"]) for row in first["changed"]}
    assert changed == {name: ("another", name, frozen[name]) for name in ("score", "cluster")}
    assert second["changed"] == []


def test_moved_modules_are_recorded_with_both_names(tmp_path: Path) -> None:
    path = write_frozen(tmp_path / "records", tmp_path)
    present = json.loads(path.read_text(encoding="utf-8"))
    tables_name, records_name = "benchmarks.across_junctions.tables", "benchmarks.across_junctions.records"
    former = {name: digest for name, digest in present.items() if name not in (tables_name, records_name)}
    former |= {"benchmarks.former": present[tables_name], "benchmarks.dropped": "1"}
    path.write_text(json.dumps(former), encoding="utf-8")
    for wrong in (
        {"benchmarks.unknown": tables_name},
        {"benchmarks.former": "benchmarks.unknown"},
        {"score": "cluster"},
    ):
        with pytest.raises(InputError, match="expected the former and the present name of a frozen module"):
            write_frozen(tmp_path / "records", tmp_path, again="moved", renamed=wrong)
    with pytest.raises(InputError, match="is recorded with a reason only"):
        write_frozen(tmp_path / "records", tmp_path, renamed={"benchmarks.former": tables_name})
    write_frozen(tmp_path / "records", tmp_path, again="moved", renamed={"benchmarks.former": tables_name})
    check_frozen(tmp_path)
    ((entry,), digest) = json.loads(path.read_text(encoding="utf-8"))["frozen again"], present[tables_name]
    assert [list(row.values()) for row in entry["changed"]] == [
        ["benchmarks.former", digest, tables_name, digest],
        ["benchmarks.dropped", "1", "benchmarks.dropped", None],
        [records_name, None, records_name, present[records_name]],
    ]


def test_each_recorded_change_starts_where_the_one_before_ended() -> None:
    hashes = json.loads((FOLDER / FROZEN_FILE).read_text(encoding="utf-8"))
    changes = hashes.pop("frozen again")
    assert all(change["changed"] for change in changes)
    for change in reversed(changes):
        for row in change["changed"]:
            assert hashes.get(row["new name"]) == row["new hash"]
        for row in change["changed"]:
            hashes.pop(row["new name"], None)
        hashes |= {row["name"]: row["hash"] for row in change["changed"] if row["hash"]}
    # of commit 7996a952, which froze the modules first
    assert hashes["benchmarks.across_junctions.tables"].startswith("2b4022f6")
    assert hashes["score"].startswith("d277d0d0")


def test_list_records_changes_only_when_it_freezes(capsys: pytest.CaptureFixture[str]) -> None:
    for option in (["--again", "moved"], ["--renamed", "a=b"]):
        assert command.main(["list", *option]) == 2
        assert "--again, --renamed: expected --freeze beside them" in capsys.readouterr().err


def test_list_prints_the_hash(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["list"]) == 0
    printed = capsys.readouterr().out
    assert f"SHA-256 of the protocol: {ProtocolFiles().digest}" in printed
    assert "held out" in printed


# ---- measuring


@pytest.mark.slow
def test_detections_depend_on_no_other_source(tmp_path: Path) -> None:
    """Every module of the program that runs is followed, calls only, or reads and writes files.

    Static world and traffic count by the keys of their stages.
    """
    scenario = with_sites(
        load(write_mini(tmp_path / "mini")), [Site("a", Pose(0.0, -7.0, 3.0), "small", pole="a")], tmp_path / "s.csv"
    )
    held_out = prepare_held_out_traffic(scenario, tmp_path / "unseen", 20, apart_s=1.0)
    executed: set[str] = set()

    def record(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            executed.add(frame.f_globals.get("__name__", ""))

    sys.setprofile(record)
    try:
        detections.run(held_out, "cluster", jobs=1)
    finally:
        sys.setprofile(None)
    followed = set(stage_keys.source_modules(*detections.COMPUTING, cluster.__name__))
    followed |= set(stage_keys.source_modules("egvs.stages.traffic", "egvs.stages.statics"))
    files_only = (
        "egvs.core.", "egvs.artefacts.", "egvs.runs.", "egvs.stages.scene_dependencies", "egvs.kernels.jit",
        "egvs.kernels.kernel_cache",
    )  # fmt: skip
    others = {name for name in executed if name.startswith(("egvs.", "benchmarks."))} - followed - {*detections.CALLING}
    assert {name for name in others if not name.startswith(files_only)} == set()
    assert "egvs.clouds.simulation" in executed and cluster.__name__ in executed


@pytest.mark.slow
def test_a_part_is_measured_once_and_the_same_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurement, "check_unseen", lambda scenario: None)  # its traffic is a finished file
    protocol = read_protocol().model_copy(update={"apart_s": 1.0})
    junction = protocol.junction("hill")
    sites = {
        Site("a", Pose(0.0, -7.0, 3.0), "small", pole="a"): 3.0,
        Site("b", Pose(8.0, 7.0, 4.0), "small", pole="b"): 4.0,
    }
    scenario = write_mini(tmp_path / "mini")
    texts: list[str] = []
    few = [entry for entry in surrogates.score_catalogue() if entry.name == "points_on_target"]
    monkeypatch.setattr(surrogates, "score_catalogue", lambda: few)

    def measured(part: str, folder: str, again: str = "") -> PartInfo:
        plan = measurement.PartPlan(
            protocol, "hash", junction, part, scenario, sites, measurement.Extent(20, 2), tmp_path / folder, again
        )
        return measurement.measure(plan, jobs=1, report=texts.append)

    infos = [measured(part, "one") for part in ("vehicles", "cluster", "scores")]
    assert all(info.is_trial and info.frames == 20 and info.candidates == 2 for info in infos)
    assert texts == []
    assert measured("cluster", "one") == infos[1]
    assert texts == ["hill cluster: measured before"]
    for part in ("vehicles", "cluster", "scores"):
        assert measured(part, "two").key == next(info.key for info in infos if info.part == part)
    # a junction that is not for training is measured once
    entry = PartInfo.read(tmp_path / "one" / "hill.cluster.json")
    PartInfo(**{**vars(entry), "key": "another"}).write(tmp_path / "one")
    junction = junction.model_copy(update={"role": "held out"})
    with pytest.raises(InputError, match="was measured before"):
        measured("cluster", "one")
    assert measured("cluster", "one", again="a fault").again == ("a fault",)
    for path in (tmp_path / "one").glob("*.parquet"):
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()

    record = records.read_junction(tmp_path / "one", "hill")
    assert record.sites == ("a", "b")
    assert record.height_m.tolist() == [3.0, 4.0]
    assert set(record.detections["cluster"]) == set(MEASURES)
    vehicles = records.read_table(tmp_path / "one" / "hill.vehicles.parquet")
    features = records.read_table(tmp_path / "one" / "hill.features.parquet").to_pydict()
    hits = records.read_table(tmp_path / "one" / "hill.cluster.hits.parquet").to_pydict()
    assert len(vehicles) == infos[0].vehicle_frames
    assert features["site"] == hits["site"] == ["a"] * len(vehicles) + ["b"] * len(vehicles)
    assert features["row"] == hits["row"]
    assert set(hits["hits"]) <= {0.0, 0.5, 1.0}
    mean_points = np.array(features["points"]).reshape(2, -1).mean(axis=1)
    assert (mean_points > 0).all()
    # the traffic is a finished file, so the traffic behind the scores has the same vehicles
    assert record.scores[measurement.MEAN_POINTS] == pytest.approx(mean_points, rel=0.5)
