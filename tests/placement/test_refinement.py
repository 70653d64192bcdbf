"""Refining plans: the freedom of each sensor, the search, and plans that are never worse and keep all rules."""

from __future__ import annotations

import csv
import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

import egvs
from egvs.core.errors import InputError
from egvs.placement import plan as placement_plan
from egvs.placement import refinement
from egvs.placement.refinement import Freedom, minimise, sensor_freedoms
from egvs.results.plans import PlannedSensor, SensorPlan
from egvs.scenario.score_config import RefinementConfig
from egvs.sensors.sites import Pose, Site
from egvs.sensors.sites import candidate_sites as sites_of
from egvs.traffic import network, sumo_folder
from tests.conftest import BUILDING
from tests.stages.conftest import net_xml

HALVES = 'traffic.periods=[{name="a", length_s=12, weight=3}, {name="b", begin_s=12, length_s=8}]'
FEW = "placement.refine.evaluations=60"


def make_plan(folder: Path, *settings: str, jobs: int = 1, out: str = "run") -> SensorPlan:
    """Return a refined plan, with few evaluations."""
    overrides = ["placement.count=2", FEW, *settings]
    return placement_plan.place(egvs.load(folder, overrides), folder / out, jobs=jobs)


def write_sites(folder: Path, poses: dict[str, Pose]) -> None:
    """Write these poses as the candidates."""
    with (folder / "sites.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ["site", *asdict(next(iter(poses.values())))])
        writer.writeheader()
        writer.writerows({"site": name, **asdict(pose)} for name, pose in poses.items())


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        (),
        ("placement.count=1",),
        ("placement.survives=1",),
        (HALVES, "placement.objective='worst'"),
        (HALVES, "placement.objective='worst'", "placement.survives=1", "placement.refine.radius_m=2"),
        ("placement.forced=['pole_a']",),
        ("score.rank_by='points_on_target'",),
        ("score.rank_by='expected_detections'", "placement.refine.radius_m=2"),
        ("placement.zones={west = {polygon_m = [[0, -10], [20, -10], [20, 10], [0, 10]], share = 0.5}}",),
        ("placement.zones={all = {polygon_m = [[0, -10], [40, -10], [40, 10], [0, 10]], share = 0.1, by = 2}}",),
    ],
)
def test_refined_plan_is_never_worse(mini: Path, settings: tuple[str, ...]) -> None:
    placed = make_plan(mini, *settings)
    assert placed.refinement is not None
    point = placed.curve[-1]
    assert placed.refinement.joint_before == point.score
    assert placed.refinement.value_before == point.value
    assert placed.refinement.value_after > placed.refinement.value_before
    if point.value == point.score:
        assert (placed.refinement.value_after, placed.joint > placed.refinement.joint_before) == (placed.joint, True)
    assert placed.sensors[-1].score == placed.joint
    assert all(zone.seen >= zone.share for zone in placed.zones)
    assert {sensor.site for sensor in placed.sensors} == set(placed.curve[-1].sites)


@pytest.mark.slow
def test_score_equals_that_of_candidates_at_refined_poses(mini: Path) -> None:
    """Bit for bit: a scenario with the refined poses as sites has the same plan and scores without refinement.

    The same holds if one sensor returns to its original pose.
    """
    original = {site.name: site.pose for site in sites_of(egvs.load(mini))}
    placed = make_plan(mini, "placement.refine.radius_m=2", "placement.refine.heights_m=[2, 5]")
    moved = {sensor.site: pose_of(sensor) for sensor in placed.sensors}
    assert moved.keys() == original.keys()
    unrefined = _place_without_refinement(mini, moved)
    assert unrefined.joint == placed.joint
    assert [(sensor.site, sensor.gain, sensor.loss) for sensor in unrefined.sensors] == [
        (sensor.site, sensor.gain, sensor.loss) for sensor in placed.sensors
    ]
    for sensor in placed.sensors:
        name = sensor.site
        assert (
            placed.joint - _place_without_refinement(mini, moved | {name: original[name]}).joint
            == sensor.gain_by_refining
            > 0
        )
        assert sensor.moved_m == pytest.approx(math.dist(moved[name].position_m, original[name].position_m))


def pose_of(sensor: PlannedSensor) -> Pose:
    return Pose(sensor.x_m, sensor.y_m, sensor.z_m, sensor.yaw_deg, sensor.pitch_deg, sensor.roll_deg)


def _place_without_refinement(folder: Path, poses: dict[str, Pose]) -> SensorPlan:
    text = (folder / "sites.csv").read_text()
    write_sites(folder, poses)
    placed = placement_plan.place(egvs.load(folder, [f"placement.count={len(poses)}"]), folder / "again", jobs=1)
    (folder / "sites.csv").write_text(text)
    return placed


@pytest.mark.slow
def test_finds_best_of_fine_grid_from_worst_corner(mini: Path) -> None:
    """One sensor with free height and pitch: all of 5 heights by 41 pitches, and 200 poses from the worst corner."""
    heights, pitches = [2, 3, 4, 5, 6], list(range(-30, 11))
    grid = {f"{z:g}/{p}".replace("/", "_"): Pose(10, 12, z, 0.0, p) for z in heights for p in pitches}
    write_sites(mini, grid)
    grid_scenario = egvs.load(mini, ["score.standard_error=false", "scan.keep=false"])
    egvs.run(grid_scenario, mini / "grid", jobs=1)
    scores = dict(zip(grid, pq.read_table(mini / "grid" / "scores.parquet").column("egvs").to_pylist(), strict=True))
    worst = min((f"{z:g}_{p}" for z in (2, 6) for p in (-30, 10)), key=lambda name: scores[name])
    assert scores[worst] < 0.8 * max(scores.values())
    write_sites(mini, {"corner": grid[worst]})
    ranges = ("placement.refine.heights_m=[2, 6]", "placement.refine.yaw_deg=[0, 0]")
    placed = make_plan(mini, "placement.count=1", "placement.refine.evaluations=200", *ranges)
    assert placed.refinement is not None and placed.refinement.joint_before == scores[worst]
    assert placed.joint >= max(scores.values())


@pytest.mark.slow
def test_infeasible_poses_are_counted_and_never_used(mini: Path) -> None:
    """The polygon surrounds a building, in which no sensor can be."""
    polygon = "[[10, 3], [22, 3], [22, 13], [9, 13]]"
    placed = make_plan(mini, f"placement.refine.within_m=[{polygon}]", "placement.refine.heights_m=[0.5, 5]")
    assert placed.refinement is not None and placed.refinement.poses_infeasible > 0
    house = shapely.Polygon(BUILDING[0])
    for sensor in placed.sensors:
        assert not house.contains(shapely.Point(sensor.x_m, sensor.y_m))


@pytest.mark.slow
def test_poles_do_not_move_onto_lanes(mini: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two lanes between y = -3.2 and 3.2; the polygon lets the pole move from y = 4.2 to 0."""
    (mini / "net.net.xml").write_text(net_xml())
    write_sites(mini, {"a": Pose(10, 4.2, 3.0)})
    settings = "placement.count=1", "placement.refine.within_m=[[[9, 0], [11, 0], [11, 4.4], [9, 4.4]]]"
    anywhere = make_plan(mini, *settings)
    monkeypatch.setattr(sumo_folder, "read_network", lambda _: network.read_net_xml(mini / "net.net.xml"))
    off_lanes = make_plan(mini, *settings)
    assert anywhere.refinement is not None and anywhere.refinement.poses_infeasible == 0
    assert (
        off_lanes.refinement is not None
        and off_lanes.refinement.poses_infeasible > 0.1 * off_lanes.refinement.poses_tried
    )
    assert off_lanes.sensors[0].y_m > 3.0


@pytest.mark.slow
def test_refined_plan_keeps_budget(mini: Path) -> None:
    """Behind a building 6 m high, a higher sensor is better and more expensive."""
    write_sites(mini, {"a": Pose(16, 8.4, 7.0)})
    settings = "placement.count=1", "placement.refine.heights_m=[6, 9]", "costs.metre=100"
    scarce, ample = (make_plan(mini, *settings, f"placement.budget={budget}") for budget in (750, 9000))
    assert 700 < scarce.cost <= 750 < ample.cost
    assert scarce.cost == pytest.approx(100 * scarce.sensors[0].z_m)
    assert scarce.refinement is not None and ample.refinement is not None
    assert scarce.refinement.joint_before == ample.refinement.joint_before < scarce.joint < ample.joint


def test_rejects_candidates_that_see_nothing(mini: Path) -> None:
    """The only candidate looks into the sky."""
    write_sites(mini, {"a": Pose(20, 9.5, 3.0, pitch_deg=80)})
    text = (mini / "scenario.toml").read_text()
    narrow = text.replace("channels = 8", "channels = 1").replace("[-15, 5]", "[80, 80]")
    (mini / "scenario.toml").write_text(narrow)
    with pytest.raises(egvs.InputError, match=r"the joint score .egvs. of all candidates is 0"):
        make_plan(mini, "placement.count=1")


@pytest.mark.slow
@pytest.mark.parametrize(("setting", "least_m"), [("placement.least_distance_m=2.5", 2.5), ("seed=7", 1.0)])
def test_sensors_keep_their_distance(mini: Path, setting: str, least_m: float) -> None:
    """Two poles are best in the same corner of a polygon; by default, poles stay 1 m apart."""
    write_sites(mini, {"a": Pose(19, 11, 3.0), "b": Pose(21.5, 11, 3.0)})
    polygon = "[[18, 8], [23, 8], [23, 12], [18, 12]]"
    placed = make_plan(mini, f"placement.refine.within_m=[{polygon}]", setting)
    assert math.dist(*(pose_of(sensor).position_m for sensor in placed.sensors)) >= least_m
    assert placed.refinement is not None and placed.refinement.poses_infeasible > 0


@pytest.mark.slow
def test_forced_sensor_stays_and_costs_nothing(mini: Path) -> None:
    placed = make_plan(mini, "placement.forced=['pole_a']", "placement.refine.radius_m=2", "costs.pole=5")
    forced, other = placed.sensors
    assert forced.forced and pose_of(forced) == Pose(10, 12, 3) and (forced.moved_m, forced.cost) == (0.0, 0.0)
    assert other.moved_m > 0.0 and other.cost == 5.0


@pytest.mark.slow
def test_same_bytes_twice_and_with_two_threads(mini: Path) -> None:
    written = []
    for jobs in (1, 1, 2):
        make_plan(mini, "placement.refine.radius_m=1", jobs=jobs)
        written.append([(mini / "run" / name).read_bytes() for name in ("placement.parquet", "curve.parquet")])
    assert written[0] == written[1] == written[2]


@pytest.mark.slow
def test_command_reports_refinement(mini: Path, run_egvs) -> None:
    out = mini / "run"
    assert run_egvs("run", mini, "--out", out)[0] == 0
    code, printed, _ = run_egvs("place", mini, "--count", 2, "--refine", "--out", out, "--set", FEW)
    assert code == 0
    moved = "moved from the positions of the candidates (<code>--refine</code>), where their joint score is 2,650"
    assert moved in (out / "report.html").read_text()
    assert "Refined: EGVS 2,650 before, " in printed
    assert "the proof applies to the poses before" in printed
    assert "gained by moving" in printed
    table = pq.read_table(out / "placement.parquet")
    assert min(table.column("gain_by_refining").to_pylist()) > 0.0
    assert table.column("moved_m").to_pylist() == [0.0, 0.0]
    assert "; objective " not in printed
    code, printed, _ = run_egvs("place", mini, "--count", 2, "--refine", "--out", out, "--set", FEW, "--set",
                         "placement.survives=1")  # fmt: skip
    assert code == 0 and "; objective " in printed
    code, printed, _ = run_egvs("place", mini, "--count", 2, "--out", out)
    assert code == 0 and "moved" not in printed
    assert "moved_m" not in pq.read_table(out / "placement.parquet").column_names


def test_rejects_plan_without_freedom(mini: Path, run_egvs) -> None:
    code, _, error = run_egvs("place", mini, "--count", 2, "--refine", "--out", mini / "run", "--set",
                         "placement.forced=['pole_a', 'pole_b']")  # fmt: skip
    assert code == 2
    assert "placement.refine: no sensor of the plan can move" in error
    assert not (mini / "run" / "placement.parquet").exists()


@pytest.mark.slow
def test_turn_respects_number_of_evaluations(mini: Path) -> None:
    placed = make_plan(mini)
    assert placed.refinement is not None
    assert placed.refinement.poses_tried <= 60 * placed.refinement.turns
    assert refinement.MIN_IMPROVEMENT > 0.0


LINE = "[[sites.along]]\nline_m = [[0, 12], [10, 12], [10, 20]]\nspacing_m = 4\nheights_m = [3, 5]\n"


def make_site(name: str, x_m: float, y_m: float, z_m: float = 3.0, **more: float) -> Site:
    """Return the site of a pole with one sensor."""
    return Site(name, Pose(x_m, y_m, z_m, **more), "small", pole=name)


def find_freedoms(
    folder: Path, config: RefinementConfig, *sites: Site, stay: tuple[bool, ...] = ()
) -> tuple[Freedom | None, ...]:
    """Return the freedoms of sites that are all part of the plan."""
    return sensor_freedoms(egvs.load(folder), config, sites, sites, stay or tuple(False for _ in sites))


def find_freedom(folder: Path, config: RefinementConfig, *sites: Site) -> Freedom:
    """Return the freedom of the first site."""
    freedom = find_freedoms(folder, config, *sites)[0]
    assert freedom is not None
    return freedom


def use_line(folder: Path) -> Path:
    """Put the sites of a scenario along a line with a corner."""
    text = (folder / "scenario.toml").read_text().replace('[sites]\nfile = "sites.csv"\n', "[sites]\n")
    (folder / "scenario.toml").write_text(text + "\n" + LINE)
    return folder


def test_sensor_turns_and_tilts_at_fixed_pole(mini: Path) -> None:
    freedom = find_freedom(mini, RefinementConfig(), make_site("a", 10, 12), make_site("b", 30, -12, 5.0))
    assert [(axis.name, axis.low, axis.high) for axis in freedom.axes] == [
        ("z_m", 3.0, 5.0),
        ("yaw_deg", -180.0, 180.0),
        ("pitch_deg", -30.0, 10.0),
    ]
    assert not freedom.moves_pole
    assert freedom.ends == ([0.0, None, 0.0], [1.0, None, 1.0])
    assert freedom.pose_at(np.array([0.5, 1.75, 0.25])) == Pose(10, 12, 4.0, 90.0, -20.0, 0.0)


@pytest.mark.parametrize(
    ("roll_deg", "at_low", "at_high"), [(0.0, -5.0, 15.0), (180.0, 175.0, -165.0), (-178.5, 175.0, -165.0)]
)
def test_limits_of_roll_count_from_the_mount(mini: Path, roll_deg: float, at_low: float, at_high: float) -> None:
    config = RefinementConfig(roll_deg=(-5.0, 15.0), yaw_deg=(0.0, 0.0), pitch_deg=(0.0, 0.0))
    site = make_site("a", 10, 12, roll_deg=roll_deg)
    freedom = find_freedom(mini, config, site)
    assert [axis.name for axis in freedom.axes] == ["roll_deg"]
    assert freedom.pose_at(freedom.point(site.pose)) == site.pose
    ends = [freedom.pose_at(np.array([share])) for share in (0.0, 1.0)]
    assert [pose and pose.roll_deg for pose in ends] == [at_low, at_high]


@pytest.mark.slow
@pytest.mark.parametrize("settings", [(), ("placement.refine.roll_deg=[-10, 10]",)])
def test_refined_sensor_stays_upside_down(mini: Path, run_egvs, settings: tuple[str, ...]) -> None:
    keys = ["sites.mount=inverted", "sites.roll_deg=2", "placement.refine.evaluations=20", *settings]
    options = [word for key in keys for word in ("--set", key)]
    code, printed, error = run_egvs("place", mini, "--count", 1, "--refine", *options, "--out", mini / "run")
    assert code == 0, error
    (roll_deg,) = pq.read_table(mini / "run" / "placement.parquet").column("roll_deg").to_pylist()
    assert abs(roll_deg) > 165.0
    assert settings or roll_deg == -178.0
    assert "upside down" in printed


def test_pose_outside_ranges_begins_at_nearest_end(mini: Path) -> None:
    tilted = make_site("a", 10, 12, pitch_deg=-45.0, yaw_deg=270.0)
    freedom = find_freedom(mini, RefinementConfig(), tilted, make_site("b", 30, -12, 5.0))
    assert freedom.point(tilted.pose).tolist() == [0.0, 0.25, 0.0]


def test_pole_on_line_moves_by_half_spacing_within_ends(mini: Path) -> None:
    folder = use_line(mini)
    sites = sites_of(egvs.load(folder))
    assert [site.name for site in sites][:2] == ["a01@3m", "a01@5m"]
    first, corner = sites[0], sites[4]  # at 0 m and at 8 m of 18 m
    start, around_corner = find_freedoms(folder, RefinementConfig(), first, corner)
    assert start is not None and around_corner is not None
    assert (start.axes[0].low, start.axes[0].high) == (0.0, 2.0)
    assert (around_corner.axes[0].low, around_corner.axes[0].high) == (6.0, 10.0)
    assert around_corner.pose_at(np.array([0.75, 0.25, 0.0])) == Pose(9.0, 12.0, 3.0, -90.0, -30.0)
    wide = find_freedom(folder, RefinementConfig(radius_m=3.5), corner)
    turned = wide.pose_at(np.array([1.0, 0.5, 0.75]))  # 11.5 m along: 1.5 m behind the corner
    assert turned == Pose(10.0, 13.5, 3.0, 0.0, 0.0)
    assert wide.point(turned).tolist() == pytest.approx([1.0, 0.5, 0.75])
    fixed = find_freedom(folder, RefinementConfig(radius_m=0.0), corner)
    assert not fixed.moves_pole


@pytest.mark.slow
@given(st.lists(st.floats(0, 1), min_size=4, max_size=4))
def test_pole_stays_in_circle(tmp_path_factory: pytest.TempPathFactory, shares: list[float]) -> None:
    from tests.conftest import write_mini

    folder = tmp_path_factory.mktemp("circle") / "mini"
    write_mini(folder)
    freedom = find_freedom(folder, RefinementConfig(radius_m=2.0), make_site("a", 10.25, 12.125))
    pose = freedom.pose_at(np.array(shares))
    assert pose is not None
    assert math.hypot(pose.x_m - 10.25, pose.y_m - 12.125) <= 2.0
    assert -30 <= pose.pitch_deg <= 10 and -180 <= pose.yaw_deg <= 180
    assert all(round(value, 3) == value for value in pose.position_m)


def test_pole_in_polygon_moves_within_it(mini: Path) -> None:
    triangle = ((8.0, 10.0), (16.0, 10.0), (8.0, 18.0))
    inside, outside = find_freedoms(
        mini, RefinementConfig(within_m=(triangle,)), make_site("a", 10, 12), make_site("b", 30, -12)
    )
    assert inside is not None and outside is not None
    assert not outside.moves_pole
    assert inside.pose_at(np.array([0.25, 0.25, 0.5, 0.5])) == Pose(10.0, 12.0, 3.0, 0.0, -10.0)
    assert inside.pose_at(np.array([0.75, 0.75, 0.5, 0.5])) is None


def test_pole_with_several_sensors_is_fixed(mini: Path) -> None:
    upper = Site("a@5m", Pose(10, 12, 5.0), "small", pole="a")
    freedoms = find_freedoms(
        mini, RefinementConfig(radius_m=2.0), make_site("a", 10, 12), upper, make_site("b", 30, -12)
    )
    assert [freedom is not None and freedom.moves_pole for freedom in freedoms] == [False, False, True]
    with_forced = find_freedoms(mini, RefinementConfig(radius_m=2.0), make_site("a", 10, 12), upper, stay=(True, False))
    assert with_forced[0] is None and with_forced[1] is not None and not with_forced[1].moves_pole


def test_measured_scan_is_fixed(mini: Path) -> None:
    measured = Site("m", Pose(10, 12, 3.0), "small", points="scan.ply", pole="m")
    assert find_freedoms(mini, RefinementConfig(), measured, make_site("b", 30, -12))[0] is None


def test_rejects_ranges_without_freedom(mini: Path) -> None:
    with pytest.raises(InputError, match=r"placement\.refine: no sensor of the plan can move"):
        find_freedoms(mini, RefinementConfig(yaw_deg=(0, 0), pitch_deg=(0, 0)), make_site("a", 10, 12))


def test_rejects_polygon_without_candidate_before_running(mini: Path, run_egvs) -> None:
    polygons = "[[[9, 11], [11, 11], [11, 13]], [[0, 0], [1, 0], [0, 1]]]"
    code, _, error = run_egvs("place", mini, "--count", 1, "--out", mini / "run", "--set",
                         f"placement.refine.within_m={polygons}")  # fmt: skip
    assert code == 2
    assert "scenario.toml: placement.refine.within_m: polygon 1: no candidate" in error
    assert not (mini / "run" / "trajectories.parquet").exists()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("heights_m=[5, 3]", "expected the lower limit first, got 5 and 3"),
        ("pitch_deg=[-100, 0]", "greater than or equal to -90"),
        ("evaluations=5", "greater than or equal to 20"),
        ("within_m=[[[0, 0], [1, 1], [2, 2]]]", "expected a polygon that encloses an area"),
        ("radius_m=-1", "greater than or equal to 0"),
    ],
)
def test_rejects_wrong_keys(mini: Path, setting: str, message: str) -> None:
    with pytest.raises(InputError, match=rf"placement\.refine\.{setting.partition('=')[0]}.*{message}"):
        egvs.load(mini, [f"placement.refine.{setting}"])


MINIMUM = np.array([0.95, 0.3, 1.0])
ENDS: tuple[list[float | None], list[float | None]] = ([None, 0.0, 0.0], [None, 1.0, 1.0])


def record_search(axes: int, evaluations: int, start: float = 0.5, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the points that a search evaluates, and their losses.

    The loss is the squared distance from the minimum; the first axis is a circle.
    """
    points, losses = [], []

    def losses_of(some: np.ndarray) -> np.ndarray:
        offset = some - MINIMUM[:axes]
        offset[:, 0] -= np.rint(offset[:, 0])
        points.append(some)
        losses.append((offset**2).sum(axis=1))
        return losses[-1]

    ends = ENDS[0][:axes], ENDS[1][:axes]
    minimise(losses_of, np.full(axes, start), ends, evaluations, np.random.default_rng(seed))
    return np.concatenate(points), np.concatenate(losses)


@pytest.mark.parametrize("axes", [1, 2, 3])
@pytest.mark.parametrize("start", [0.0, 0.45])
def test_finds_minimum_across_end_of_circle_and_at_end_of_range(axes: int, start: float) -> None:
    points, losses = record_search(axes, 400, start)
    assert len(points) <= 400
    assert losses.min() < 1e-5
    assert ((points[:, 1:] >= 0.0) & (points[:, 1:] <= 1.0)).all()


def test_uses_only_the_given_generator() -> None:
    before = global_state()
    np.testing.assert_array_equal(record_search(3, 100)[0], record_search(3, 100)[0])
    assert not np.array_equal(record_search(3, 100)[0], record_search(3, 100, seed=1)[0])
    assert global_state() == before


def global_state() -> str:
    """Return the state of NumPy's global generator."""
    return repr(np.random.get_state(legacy=False))  # noqa: NPY002 - what libraries may draw from


def test_equal_losses_end_search() -> None:
    calls = []
    minimise(
        lambda some: calls.append(len(some)) or np.full(len(some), 1e6),  # type: ignore[func-returns-value]
        np.full(2, 0.5),
        ([0.0, 0.0], [1.0, 1.0]),
        100_000,
        np.random.default_rng(0),
    )
    assert sum(calls) < 30_000


def test_pole_that_moves_on_slope_keeps_its_height_above_ground(mini: Path) -> None:
    """The ground rises by 0.2 m per metre to the east: sensors 3 m and 5 m above it."""

    def ground_m(x_m: float, _: float) -> float:
        return 0.2 * x_m

    low, high = make_site("a", 10, 12, 5.0), make_site("b", 30, -12, 11.0)
    config = RefinementConfig(radius_m=2.0)
    freedom, other = sensor_freedoms(egvs.load(mini), config, [low, high], [low, high], [False, False], ground_m)
    assert freedom is not None and other is not None
    assert [(axis.name, axis.low, axis.high) for axis in freedom.axes[:3]] == [
        ("x_m", 8.0, 12.0), ("y_m", 10.0, 14.0), ("z_m", 3.0, 5.0),
    ]  # fmt: skip
    moved = freedom.pose_at(np.array([0.75, 0.5, 0.25, 0.5, 0.75]))
    assert moved == Pose(11.0, 12.0, 3.5 + 2.2, 0.0, 0.0)
    assert freedom.point(moved).tolist() == [0.75, 0.5, 0.25, 0.5, 0.75]
    fixed = sensor_freedoms(egvs.load(mini), RefinementConfig(heights_m=(4, 4)), [low], [low], [False], ground_m)[0]
    assert fixed is not None
    assert fixed.pose_at(np.array([0.5, 0.75])) == low.pose  # no axis for its height: it stays 3 m above the ground
