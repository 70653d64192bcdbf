"""Do divergence, mount_sway and foliage change the empty scan as they say, and nothing when they cannot?"""

from __future__ import annotations

import itertools
import json
import math
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.tpog import Tpog
from egvs.core import files
from egvs.core.grid import Grid, Roi
from egvs.effects.divergence import Divergence
from egvs.effects.divergence import beam_nodes as cone_nodes
from egvs.effects.foliage import Foliage
from egvs.effects.mount_sway import MountSway, rotate_directions
from egvs.effects.mount_sway import tilt_nodes as sway_nodes
from egvs.effects.rain import Rain
from egvs.scenario.effects_config import DivergenceParameters, FoliageParameters, MountSwayParameters, RainParameters
from egvs.scoring.scorer import Scorer
from egvs.sensors import sites
from egvs.sensors.scanner import Scanner
from egvs.sensors.sensor import Sensor, rotation_world_sensor
from egvs.sensors.sites import Pose
from egvs.stages import scan, statics
from egvs.stages.inputs import get_scene, open_folder
from egvs.stages.site_scoring import empty_scans
from egvs.world import ray_casting, static_world
from egvs.world.footprints import Footprint
from egvs.world.mesh import World, read_ply
from egvs.world.ray_casting import Caster, EmptyScan
from tests.conftest import collection, feature
from tests.stages import run_stage

FOLIAGE, DIVERGENCE, SWAY = (
    "effects.foliage.leaf_area_density=",
    "effects.divergence.sub_beams=",
    "effects.mount_sway.tilt_deg=",
)
OPAQUE = 1e15


def prism(
    x0: float, y0: float, x1: float, y1: float, base: float, top: float, kind: str, name: str = "it"
) -> dict[str, Any]:
    ring = [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]
    return feature({"type": "Polygon", "coordinates": [ring]}, name=name, kind=kind, base_m=base, height_m=top)


def place(mini: Path, *standing: dict[str, Any], sites: str | None = None) -> Path:
    """The small scenario with other static geometry, and other sites."""
    (mini / "statics.geojson").write_text(collection(*standing))
    if sites is not None:
        (mini / "sites.csv").write_text("site,x_m,y_m,z_m\n" + sites)
    return mini


def one_beam(mini: Path, *standing: dict[str, Any], divergence: str = "") -> Path:
    """One site 10 m before the region of interest, whose only beam in reach goes along y = 0.25, z = 2.25, where voxels
    have their middles; the ground is left away."""
    place(mini, *standing, sites="only,-10,0.25,2.25\n")
    text = (mini / "scenario.toml").read_text()
    text = text.replace(
        "elevations_deg = [-15, 5]\nchannels = 8\nazimuth_step_deg = 1.0", "elevations_deg = [0]\nazimuth_step_deg = 90"
    )
    (mini / "scenario.toml").write_text(text.replace("[statics]", "[statics]\nground = false") + divergence)
    return mini


TREES = (
    prism(12, -4, 15, -1, 1, 4, "tree_crown", "low"),
    prism(14, -3, 17, 0.5, 2, 6, "tree_crown", "overlapping"),
    prism(13.4, -2.6, 13.6, -2.4, 0, 1, "tree_trunk", "trunk"),
    prism(27, 3, 30.5, 6, 0.5, 3.5, "tree_crown", "flush with a site's x"),
    prism(24, -2, 26, 0, 0, 2, "building", "kiosk"),
)


def scanned(folder: Path, out: Path, *sets: str, jobs: int = 1) -> tuple[egvs.Scenario, Path]:
    scenario = egvs.load(folder, sets)
    run_stage(statics, scenario, out)
    run_stage(scan, scenario, out, jobs=jobs)
    return scenario, out


def hits(folder: Path, out: Path, *sets: str) -> dict[str, np.ndarray]:
    """Hits in each voxel, by site."""
    scenario, out = scanned(folder, out, *sets)
    grid = Grid.over(scenario.roi.box, scenario.roi.voxel_m)
    work, empty = open_folder(scenario, out), Tpog(grid, 1, np.zeros(grid.shape, dtype=np.int64))
    scorer = Scorer(get_scene(work), empty)
    return {scan.site.name: scorer.hits(scan.beams) for scan in empty_scans(work)}


def along(found: dict[str, np.ndarray]) -> np.ndarray:
    """Hits along the only beam of :func:`one_beam`, by the number of the voxel: x from 0 in steps of 0.5 m."""
    return found["only"][:, 20, 4]


def sums(file: Path) -> list[float]:
    """The weights of each beam, added up."""
    table, _ = parquet.read_artefact(file, "scans")
    total: dict[tuple[str, int], float] = defaultdict(float)
    for name, beam, weight in zip(*(table.column(c).to_pylist() for c in ("site", "beam", "weight")), strict=True):
        total[name, beam] += weight
    return list(total.values())


# --- divergence


@pytest.mark.parametrize(("count", "degree"), [(7, 5), (19, 5)])
def test_sub_beams_have_the_moments_of_the_gaussian_profile(count: int, degree: int) -> None:
    offsets, weights = cone_nodes(count)
    assert len(weights) == count and weights.min() > 0
    assert math.fsum(weights) == pytest.approx(1, abs=1e-15)
    sigma = 1 / 4  # the intensity is 1/e^2 at two standard deviations, which is half the full angle
    for a in range(degree + 1):
        for e in range(degree + 1 - a):
            exact = 0.0 if a % 2 or e % 2 else sigma ** (a + e) * math.prod(range(1, a, 2)) * math.prod(range(1, e, 2))
            assert (weights * offsets[:, 0] ** a * offsets[:, 1] ** e).sum() == pytest.approx(
                exact, rel=1e-14, abs=1e-15
            )


def test_radial_moments_of_19_sub_beams() -> None:
    offsets, weights = cone_nodes(19)
    s = 8 * (offsets**2).sum(axis=1)
    assert [(weights * s**n).sum() for n in range(5)] == pytest.approx([math.factorial(n) for n in range(5)])


def test_sub_beams_lie_in_the_sensors_own_azimuth_and_elevation() -> None:
    sensor = Sensor("s", (10.0,), (0.0,), 8, 100.0, "", divergence_mrad=(8.0, 2.0))
    mount = Pose(0, 0, 0, yaw_deg=30, pitch_deg=-20, roll_deg=40)
    pose = mount.angles_deg
    rays, parent, weights = Divergence(DivergenceParameters()).expand(sensor.directions(*pose), sensor, mount)
    assert parent.tolist() == [i for i in range(8) for _ in range(7)]
    np.testing.assert_array_equal(rays[::7], sensor.directions(*pose))
    np.testing.assert_allclose((rays**2).sum(axis=1), 1, atol=1e-15)
    inside = rays @ rotation_world_sensor(*pose)  # back into the sensor's frame
    elevation = np.arcsin(inside[:, 2]).reshape(8, 7)
    azimuth = np.arctan2(inside[:, 1], inside[:, 0]).reshape(8, 7)
    aside = np.angle(np.exp(1j * (azimuth - azimuth[:, :1]))) * math.cos(math.radians(10))
    offsets, _ = cone_nodes(7)
    np.testing.assert_allclose(aside, np.tile(8e-3 * offsets[:, 0], (8, 1)), atol=1e-5)
    np.testing.assert_allclose(elevation - math.radians(10), np.tile(2e-3 * offsets[:, 1], (8, 1)), atol=1e-5)
    assert weights.reshape(8, 7).sum(axis=1) == pytest.approx(1)


def test_a_beam_along_the_sensors_axis_widens_too() -> None:
    sensor = Sensor("s", (90.0,), (0.0,), 1, 100.0, "", divergence_mrad=(4.0, 4.0))
    rays, _, _ = Divergence(DivergenceParameters()).expand(sensor.directions(), sensor, Pose(0, 0, 0))
    assert np.hypot(rays[1:, 0], rays[1:, 1]) == pytest.approx(2e-3, rel=1e-5)


@pytest.mark.parametrize("count", [7, 19])
def test_a_thin_pole_shades_part_of_a_cone(mini: Path, tmp_path: Path, count: int) -> None:
    """A pole of 0.1 m, 30 m away, in a cone of 10 mrad, 0.3 m wide there.

    7 sub-beams: the ring lies at half the full angle: 0.15 m x (cos 0, cos 60) = 0.15, 0.075 m aside, past the pole's
    0.05 m. The pole takes the middle, whose weight is 1/2. (A Gaussian of that width has erf(0.05 / 0.075 / sqrt 2) =
    0.495 there.) 19 sub-beams: rings at 0.15 m x sqrt((3 -+ sqrt 3) / 2) = 0.1194 and 0.2307 m. Inner: 0.1194 x cos(60
    n) = 0.0597, 0.1194: past. Outer: 0.2307 x cos(15 + 30 n) = 0.2229, 0.1631, 0.0597: all past. The middle weighs 1/3.
    """
    folder = one_beam(mini, prism(20, 0.2, 20.1, 0.3, 0, 5, "pole"))
    wide = f"{DIVERGENCE}{count}", "effects.divergence.divergence_mrad=[10, 0.1]"
    plain, cone = along(hits(folder, tmp_path / "a")), along(hits(folder, tmp_path / "b", *wide))
    assert plain[:40].tolist() == [1] * 40 and plain[41:].tolist() == [0] * 39
    assert cone[:40] == pytest.approx(1, abs=1e-8)
    assert cone[41:43] == pytest.approx({7: 1 / 2, 19: 2 / 3}[count], abs=1e-8)


def test_the_sensors_own_divergence_is_used(mini: Path, tmp_path: Path) -> None:
    """Across 3 mrad the cone is 0.09 m wide at 30 m: a pole of 0.1 m takes all of it."""
    folder = one_beam(mini, prism(20, 0.2, 20.1, 0.3, 0, 5, "pole"))
    assert not along(hits(folder, tmp_path / "a", f"{DIVERGENCE}7"))[41:].any()


# --- mount_sway


@pytest.mark.parametrize(("samples", "degree"), [(4, 3), (9, 5), (16, 7)])
def test_tilts_have_the_moments_of_the_gaussian(samples: int, degree: int) -> None:
    tilts, weights = sway_nodes(samples)
    assert len(weights) == samples and weights.min() > 0
    for a in range(degree + 1):
        for b in range(degree + 1):
            exact = 0.0 if a % 2 or b % 2 else math.prod(range(1, a, 2)) * math.prod(range(1, b, 2))
            assert (weights * tilts[:, 0] ** a * tilts[:, 1] ** b).sum() == pytest.approx(exact, rel=1e-14, abs=1e-13)


def test_a_tilt_turns_about_the_worlds_axes() -> None:
    ahead, left, up = np.eye(3)[:, None]
    assert rotate_directions(left, 90, 0)[0] == pytest.approx(up[0])  # about x: y goes up
    assert rotate_directions(up, 0, 90)[0] == pytest.approx(ahead[0])  # about y: z goes to x
    assert rotate_directions(np.array([[0.6, 0.8, 0.0]]), 0.6, 0.8)[0] == pytest.approx(
        [0.6, 0.8, 0.0]
    )  # the axis stays
    rng = np.random.default_rng(3)
    some = rng.normal(size=(50, 3))
    some /= np.linalg.norm(some, axis=1)[:, None]
    turned = rotate_directions(rotate_directions(some, 3, -4), -3, 4)
    np.testing.assert_allclose(turned, some, atol=1e-15)
    np.testing.assert_allclose(
        np.einsum("ij,ij->i", rotate_directions(some, 3, -4), some).min(), math.cos(math.radians(5)), atol=0.02
    )


def test_a_swaying_pole_sees_over_a_wall_for_its_share(mini: Path, tmp_path: Path) -> None:
    """A wall at 15 m reaches 0.05 m above the beam. 9 poses at 1 degree: 0 and -+sqrt(3) degrees about y, weighing 2/3,
    1/6, 1/6.

    The beam goes along x, so a turn about y lifts it by 15 m x tan(1.732 deg) = 0.45 m, or lowers it: 1/6 gets over the
    wall. A turn about x leaves it (but for 0.02 degrees aside)."""
    folder = one_beam(mini, prism(5, -6, 5.1, 6, 0, 2.3, "building"))
    sets = f"{SWAY}1", "effects.mount_sway.samples=9"
    found = hits(folder, tmp_path / "b", *sets)["only"]
    assert found[0].sum() == pytest.approx(1, abs=1e-8)
    assert found[12:40].max(axis=(1, 2)) == pytest.approx(1 / 6, abs=1e-8)


# --- foliage


@pytest.mark.slow
def test_leaves_let_through_what_beer_and_lambert_say(mini: Path, tmp_path: Path) -> None:
    """A crown 4 m deep, from x = 10 to 14; G x LAD = 0.5 x 0.5 = 0.25 a metre: exp(-1) = 0.3679 gets through.

    Steps of 0.5 m begin where voxels begin, so a voxel's hits are what reaches its front: exp(-0.25 (x - 10))."""
    folder = one_beam(mini, prism(10, -2, 14, 2, 1, 5, "tree_crown"))
    found = along(hits(folder, tmp_path / "a", f"{FOLIAGE}0.5", "effects.foliage.step_m=0.5"))
    x = 0.5 * np.arange(80)
    np.testing.assert_allclose(found, np.exp(-0.25 * np.clip(x - 10, 0, 4)), atol=2**-32)
    table, about = parquet.read_artefact(tmp_path / "a" / "scans.parquet", "scans")
    assert table.column("weight").to_pylist()[-1] == pytest.approx(math.exp(-1), abs=1e-9)
    assert table.column("returned").to_pylist() == [True] * 8 + [False]
    assert (about["sites"][0]["beams_in_roi"], about["sites"][0]["returns"]) == (1, 1)


@pytest.mark.parametrize(
    ("season", "share"), [("'summer'", 1.0), ("'autumn'", 0.7), ("'winter'", 0.35), ("0.125", 0.125)]
)
def test_seasons(mini: Path, tmp_path: Path, season: str, share: float) -> None:
    folder = one_beam(mini, prism(10, -2, 14, 2, 1, 5, "tree_crown"))
    found = along(hits(folder, tmp_path / "a", f"{FOLIAGE}0.5", f"effects.foliage.season={season}"))
    assert found[-1] == pytest.approx(math.exp(-share), abs=2**-32)


def test_crowns_that_overlap_add_up_and_what_is_opaque_ends_the_beam(mini: Path, tmp_path: Path) -> None:
    """k = 0.25: 4 m in one crown and 3 m in the other: exp(-7/4) reaches the wall at x = 20; nothing reaches x = 21."""
    crowns = prism(10, -2, 14, 2, 1, 5, "tree_crown", "a"), prism(12, -3, 15, 3, 0, 4, "tree_crown", "b")
    folder = one_beam(mini, *crowns, prism(20.2, -2, 21, 2, 0, 5, "building"))
    found = along(hits(folder, tmp_path / "a", f"{FOLIAGE}0.5"))
    assert found[30:41] == pytest.approx(math.exp(-7 / 4), abs=2**-31)
    assert not found[41:].any()


@pytest.mark.parametrize("step", [0.05, 0.3, 7.0])
def test_steps_change_only_what_is_within_crowns(mini: Path, tmp_path: Path, step: float) -> None:
    folder = one_beam(mini, prism(10.3, -2, 13.1, 2, 1, 5, "tree_crown"))
    found = along(hits(folder, tmp_path / "a", f"{FOLIAGE}0.5", f"effects.foliage.step_m={step}"))
    assert found[:21] == pytest.approx(1)
    assert found[27:] == pytest.approx(math.exp(-0.7), abs=2**-32)
    exact = np.exp(-0.25 * np.clip(0.5 * np.arange(80) - 10.3, 0, 2.8))
    assert np.abs(found - exact).max() < 0.25 * min(step, 2.8)


def test_denser_leaves_raise_no_voxel_and_the_densest_are_opaque(mini: Path, tmp_path: Path) -> None:
    folder = place(mini, *TREES)
    plain = hits(folder, tmp_path / "plain")
    found = [hits(folder, tmp_path / "a", f"{FOLIAGE}{density}") for density in (0, 0.2, 1, 5, 1e3, OPAQUE)]
    for site in plain:
        series = [f[site] for f in found]
        assert all((more <= less).all() for less, more in itertools.pairwise(series))
        assert series[0].sum() > series[1].sum() > series[2].sum() > series[3].sum() > plain[site].sum()
        np.testing.assert_array_equal(series[-1], plain[site])


def test_the_densest_leaves_give_the_plain_scan(mini: Path, tmp_path: Path) -> None:
    folder = place(mini, *TREES)
    _, plain = scanned(folder, tmp_path / "plain")
    _, dense = scanned(folder, tmp_path / "dense", f"{FOLIAGE}{OPAQUE}")
    (before, about), (after, about_after) = (
        parquet.read_artefact(out / "scans.parquet", "scans") for out in (plain, dense)
    )
    for name in ("site", "beam", "returned"):
        assert before.column(name) == after.column(name)
    for name in ("dx_m", "dy_m", "dz_m"):
        np.testing.assert_allclose(
            after.column(name).to_numpy(), before.column(name).to_numpy(), rtol=1e-12, atol=1e-12
        )
    assert set(after.column("weight").to_pylist()) == {1.0}
    assert about["sites"] == about_after["sites"]


def _world(*polygons: tuple[list[tuple[float, float]], float, float]) -> World:
    builder = static_world._Builder()
    for number, (ring, base, top) in enumerate(polygons):
        footprint = Footprint(str(number), "tree_crown", shapely.orient_polygons(shapely.Polygon(ring)), base, top)
        builder.add(*static_world._extrude(footprint), footprint.name, footprint.kind)
    return builder.world()


ROI = Roi((0.0, -10.0, 0.0), (40.0, 20.0, 5.0))
HOOK = [(10, -3), (18, -3), (18, 3), (14, 3), (14, -1), (12, -1), (12, 4), (10, 4)]
ROUND = [(20 + 3 * math.cos(a), 1 + 3 * math.sin(a)) for a in np.arange(16) * math.tau / 16]
CROWNS = ((HOOK, 1.0, 4.5), (ROUND, 2.0, 7.0), ([(16, -2), (24, 0), (17, 5)], 0.5, 3.0))


def _lengths(position: np.ndarray, ends: np.ndarray) -> list[float]:
    """Metres within crowns of each beam, by clipping its footprint with shapely."""
    found = []
    for end in ends:
        total = 0.0
        for ring, base, top in CROWNS:
            low, high = sorted(((z - position[2]) / end[2]) for z in (base, top)) if end[2] else (0.0, 1.0)
            low, high = max(low, 0.0), min(high, 1.0)
            if low < high and (end[2] or base < position[2] < top):
                line = shapely.LineString([(position + t * end)[:2] for t in (low, high)])
                flat = shapely.Polygon(ring).intersection(line).length
                total += flat * math.sqrt((end**2).sum()) / math.hypot(end[0], end[1])
        found.append(total)
    return found


def _cut(position: np.ndarray, ends: np.ndarray, **parameters: float) -> EmptyScan:
    cut = Foliage(FoliageParameters(**parameters)).cutter(_world(*CROWNS), ROI)
    beams = EmptyScan(np.arange(len(ends), dtype=np.uint32), ends, np.zeros(len(ends), dtype=np.bool_))
    return cut(beams, Pose(*position))


def test_lengths_within_crooked_and_overlapping_crowns_are_those_of_a_slow_twin() -> None:
    rng = np.random.default_rng(5)
    for position in (np.array([-5.0, 2.0, 3.0]), np.array([13.0, 1.0, 3.0]), np.array([18.0, -9.0, 6.5])):
        ends = rng.uniform([0, -10, 0], [40, 10, 5], (400, 3)) - position
        found = _cut(position, ends, leaf_area_density=0.2, step_m=0.7)
        share = np.zeros(400)
        np.add.at(share, found.beam, found.weight)
        assert share.tolist() == [1.0] * 400
        goes_on = np.zeros(400)
        goes_on[found.beam[~found.returned]] = found.weight[~found.returned]
        np.testing.assert_allclose(goes_on, np.exp(-0.1 * np.array(_lengths(position, ends))), atol=2e-7)
        assert (np.diff(found.beam.astype(np.int64)) >= 0).all()


def test_parts_end_within_crowns_and_along_their_beam() -> None:
    position = np.array([-5.0, 2.0, 3.0])
    ends = np.random.default_rng(6).uniform([30, -10, 0], [40, 10, 5], (200, 3)) - position
    found = _cut(position, ends, leaf_area_density=3.0)
    whole = ends[found.beam]
    np.testing.assert_allclose(np.cross(found.ends_m, whole), 0, atol=1e-10)
    where = position + found.ends_m[found.returned]
    inside = np.zeros(len(where), dtype=bool)
    for ring, base, top in CROWNS:
        near = shapely.Polygon(ring).buffer(1e-6)
        inside |= (
            shapely.contains_xy(near, where[:, 0], where[:, 1])
            & (where[:, 2] > base - 1e-6)
            & (where[:, 2] < top + 1e-6)
        )
    assert len(where) > 300 and inside.all()


def test_beams_through_edges_corners_and_along_faces() -> None:
    """A cube from 10 to 14 m; k = 0.25 a metre. A beam that lies in a face plane is inside, as it met the opaque cube;
    one that only touches an edge passes."""
    cut = Foliage(FoliageParameters(leaf_area_density=0.5)).cutter(
        _world(([(10, 0), (14, 0), (14, 4), (10, 4)], 0.0, 4.0)), ROI
    )
    cases = {
        "through two opposite upright edges": ((8, -2, 2), (8, 8, 0), 4 * math.sqrt(2)),
        "through two opposite corners": ((8, -2, -2), (8, 8, 8), 4 * math.sqrt(3)),
        "in the plane of a face": ((0, 0, 2), (30, 0, 0), 4.0),
        "along an upper edge": ((0, 0, 4), (30, 0, 0), 4.0),
        "touching an upright edge": ((8, 2, 2), (4, -4, 0), 0.0),
        "beside it": ((0, -1, 2), (30, 0, 0), 0.0),
        "ending within": ((0, 1, 2), (11, 0, 0), 1.0),
        "starting on its face": ((10, 2, 2), (20, 0, 0), 4.0),
    }
    for name, (start, end, length) in cases.items():
        beam = EmptyScan(np.zeros(1, dtype=np.uint32), np.array([end], dtype=np.float64), np.zeros(1, dtype=np.bool_))
        found = cut(beam, Pose(*start))
        assert found.weight[~found.returned].sum() == pytest.approx(math.exp(-0.25 * length), abs=3e-7), name


def test_a_crown_that_is_not_closed_stays_opaque() -> None:
    whole = _world((HOOK, 1.0, 4.0))
    open_ = World(whole.vertices_m, whole.faces[1:], whole.solid_of_face[1:], whole.solids)
    effect = Foliage(FoliageParameters())
    assert len(effect.opaque(whole).faces) == 0 and len(effect.opaque(open_).faces) == len(open_.faces)


def test_a_scene_moved_far_away_is_cut_alike(mini: Path, tmp_path: Path) -> None:
    shift = np.array([2.0**18, 2.0**22])
    here = hits(place(mini, *TREES), tmp_path / "a", f"{FOLIAGE}1", f"{DIVERGENCE}7")
    x, y = shift
    far = json.loads((mini / "statics.geojson").read_text())
    for item in far["features"]:
        item["geometry"]["coordinates"] = (np.array(item["geometry"]["coordinates"]) + shift).tolist()
    (mini / "statics.geojson").write_text(json.dumps(far))
    (mini / "sites.csv").write_text(f"site,x_m,y_m,z_m\npole_a,{10 + x},{12 + y},3\npole_b,{30.5 + x},{y - 12},3\n")
    there = hits(mini, tmp_path / "b", f"{FOLIAGE}1", f"{DIVERGENCE}7", f"roi.center_m=[{20 + x}, {y}, 2.5]")
    for site, found in here.items():
        np.testing.assert_array_equal(found, there[site])


# --- all three


EACH = {"divergence": [f"{DIVERGENCE}7"], "mount_sway": [f"{SWAY}0.5"], "foliage": [f"{FOLIAGE}0.7"]}


def scores_of(out: Path) -> list[Any]:
    table, _ = parquet.read_artefact(out / "scores.parquet", "scores")
    return table.to_pylist()


@pytest.fixture
def plain(mini: Path, tmp_path: Path) -> Path:
    place(mini, *TREES)
    egvs.run(egvs.load(mini), tmp_path / "plain", jobs=1)
    return tmp_path / "plain"


@pytest.mark.parametrize("name", EACH)
def test_the_switch_acts_and_weights_and_metadata_are_as_declared(
    mini: Path, plain: Path, tmp_path: Path, name: str
) -> None:
    out = tmp_path / "out"
    egvs.run(egvs.load(mini, EACH[name]), out, jobs=1)
    before, after = ([row["egvs"] for row in scores_of(folder)] for folder in (plain, out))
    assert all(a != b for a, b in zip(before, after, strict=True))
    table, about = parquet.read_artefact(out / "scans.parquet", "scans")
    assert table.column_names == ["site", "beam", "dx_m", "dy_m", "dz_m", "returned", "weight"]
    weights = table.column("weight").to_numpy()
    assert weights.min() >= 0 and weights.max() <= 1
    assert max(sums(out / "scans.parquet")) <= 1 + 1e-12
    for site in about["sites"]:
        mine = table.filter(np.array(table.column("site").to_pylist()) == site["site"])
        beams = mine.column("beam").to_numpy().astype(np.int64)
        assert (np.diff(beams) >= 0).all() and site["beams_in_roi"] == len(np.unique(beams))
        assert site["returns"] == len(np.unique(beams[mine.column("returned").to_numpy()]))
    assert parquet.read_artefact(plain / "scans.parquet", "scans")[0].column_names == [
        "site",
        "beam",
        "dx_m",
        "dy_m",
        "dz_m",
        "returned",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH)
def test_any_number_of_threads_gives_the_same_bytes_and_unkept_scans_the_same_scores(
    mini: Path, tmp_path: Path, plain: Path, name: str
) -> None:
    out = [plain.rename(tmp_path / str(jobs)) if jobs == 1 else tmp_path / str(jobs) for jobs in (1, 2, 3)]
    for jobs, folder in enumerate(out, start=1):
        egvs.run(egvs.load(mini, EACH[name]), folder, jobs=jobs)
    for file in ("scans.parquet", "scores.parquet"):
        assert len({files.hash_file(folder / file) for folder in out}) == 1
    kept = scores_of(out[0])
    egvs.run(egvs.load(mini, [*EACH[name], "scan.keep=false"]), out[0], jobs=2)
    assert not (out[0] / "scans.parquet").exists()
    assert scores_of(out[0]) == kept


BEHIND = prism(8, 40, 12, 44, 1, 6, "tree_crown", "far behind")
IDLE: dict[str, tuple[list[str], tuple[dict[str, Any], ...], str]] = {
    "one sub-beam": ([f"{DIVERGENCE}1"], TREES, "sub_beams is 1"),
    "no width": ([f"{DIVERGENCE}7", "effects.divergence.divergence_mrad=[0, 0]"], TREES, "divergence_mrad is 0"),
    "no tilt": ([f"{SWAY}0"], TREES, "tilt_deg is 0"),
    "one pose": ([f"{SWAY}1", "effects.mount_sway.samples=1"], TREES, "samples is 1"),
    "no crown": ([f"{FOLIAGE}1"], TREES[-1:], "there is no closed tree crown"),
    "no crown between": ([f"{FOLIAGE}1"], (*TREES[-1:], BEHIND), "no crown lies between any site and the ROI"),
    "bare crowns out of reach": ([f"{FOLIAGE}0"], (*TREES[-1:], prism(8, 12.2, 8.5, 12.4, 1, 6, "tree_crown")), ""),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", IDLE)
@pytest.mark.parametrize("keep", ["true", "false"])
def test_an_effect_that_can_change_nothing_is_skipped_and_leaves_no_trace(
    mini: Path, tmp_path: Path, case: str, keep: str
) -> None:
    sets, standing, why = IDLE[case]
    place(mini, *standing, sites="pole_a,10,12,3\npole_b,30.5,14,3\n" if case.startswith("bare") else None)
    keeps = f"scan.keep={keep}"
    egvs.run(egvs.load(mini, [keeps]), tmp_path / "plain", jobs=1)
    record = egvs.run(egvs.load(mini, [keeps, *sets]), tmp_path / "named", jobs=1)
    said = record.stages["scan"].summary
    if case.startswith("bare"):
        assert "skipped" not in said  # beams of pole_b pass it
        return
    assert said["skipped"] == [f"{sets[0].split('.')[1]}: {why}"]
    for name in ("statics.ply", "scans.parquet", "tpog.parquet", "scores.parquet"):
        if keep == "true" or name != "scans.parquet":
            assert files.hash_file(tmp_path / "plain" / name) == files.hash_file(tmp_path / "named" / name), name


@pytest.mark.parametrize("case", [case for case in IDLE if not case.startswith("bare")])
def test_skipping_gives_the_score_of_not_skipping(
    mini: Path, tmp_path: Path, case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sets, standing, _ = IDLE[case]
    place(mini, *standing)
    skipped = hits(mini, tmp_path / "a", *sets)
    for effect in (Divergence, MountSway, Foliage):
        monkeypatch.setattr(effect, "why_idle", lambda self, scene: None)
    forced = hits(mini, tmp_path / "b", *sets)
    for site, found in skipped.items():
        np.testing.assert_array_equal(found, forced[site])


def test_measured_scans_are_taken_as_they_are(mini: Path, tmp_path: Path) -> None:
    place(mini, *TREES, sites="pole_a,10,12,3\n")
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,points\nseen,10,12,3,cloud.csv\ncast,30.5,-12,3,\n")
    (mini / "cloud.csv").write_text("x_m,y_m,z_m\n20,0,0\n20,1,0.5\n")
    _, out = scanned(mini, tmp_path / "out", *(s for sets in EACH.values() for s in sets))
    table, about = parquet.read_artefact(out / "scans.parquet", "scans")
    assert table.column("weight").to_pylist()[:2] == [1.0, 1.0]
    assert about["sites"][0]["beams_in_roi"] == 2
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,points\nseen,10,12,3,cloud.csv\n")
    scene = egvs.build_scene(egvs.load(mini, [s for sets in EACH.values() for s in sets]))
    assert {effect.why for effect in scene.inactive_effects} == {"all scans are measured"} and Scanner(
        scene
    ).columns == ()


@pytest.mark.parametrize(
    "sets", [[f"{SWAY}0.01"], [f"{SWAY}3"], [f"{DIVERGENCE}19"], [f"{SWAY}3", f"{DIVERGENCE}7", f"{FOLIAGE}1"]]
)
def test_from_within_the_region_no_weight_is_lost(mini: Path, tmp_path: Path, sets: list[str]) -> None:
    _, out = scanned(place(mini, *TREES, sites="pole_a,20,1,3\n"), tmp_path / "out", *sets)
    assert sums(out / "scans.parquet") == pytest.approx([1.0] * 8 * 360, abs=1e-12)


def test_divergence_and_sway_compose(mini: Path, tmp_path: Path) -> None:
    """Every sub-beam of the cone once for each pose, with the product of the weights."""
    scenario, out = scanned(one_beam(mini), tmp_path / "out", f"{DIVERGENCE}7", f"{SWAY}0.1")
    table, _ = parquet.read_artefact(out / "scans.parquet", "scans")
    assert table.num_rows == 28
    assert sums(out / "scans.parquet") == pytest.approx([1.0], abs=1e-14)
    products = np.outer(cone_nodes(7)[1], sway_nodes(4)[1]).ravel()
    np.testing.assert_allclose(table.column("weight").to_numpy(), products, rtol=1e-15)
    ends = np.column_stack([table.column(c).to_numpy() for c in ("dx_m", "dy_m", "dz_m")]) / 100
    pose, sensor = sites.candidate_sites(scenario)[0].pose, Sensor("s", (0.0,), (0.0,), 4, 100.0, "")
    cone, _, _ = Divergence(DivergenceParameters()).expand(np.array([[1.0, 0.0, 0.0]]), sensor, pose)
    both, _, _ = MountSway(MountSwayParameters(tilt_deg=0.1)).expand(cone, sensor, pose)
    np.testing.assert_allclose(ends, both, rtol=1e-15, atol=1e-15)


def test_foliage_and_divergence_compose(mini: Path, tmp_path: Path) -> None:
    """A crown so placed that only the sub-beams on one side of the cone meet it: their 3/12 pass with exp(-1).

    At x = 10, 20 m away, a cone of 10 mrad has its ring at 0.1 and 0.05 m aside; the crown begins 0.04 m aside of the
    beam and takes the three at +0.1 and +0.05 (twice): 3/12. exp(-1) for 4 m, longer by less than 1e-4 on the slant."""
    folder = one_beam(mini, prism(10, 0.29, 14, 4, 0, 5, "tree_crown"))
    sets = f"{FOLIAGE}0.5", f"{DIVERGENCE}7", "effects.divergence.divergence_mrad=[10, 0.1]"
    found = along(hits(folder, tmp_path / "a", *sets))
    assert found[:20] == pytest.approx(1, abs=1e-8)
    assert found[28:40] == pytest.approx(1 - 3 / 12 * (1 - math.exp(-1)), abs=1e-5)


def test_foliage_and_rain_compose(mini: Path, tmp_path: Path) -> None:
    folder = one_beam(mini, prism(10, -2, 14, 2, 1, 5, "tree_crown"))
    wet = "effects.rain.rate_mm_h=50"
    dry, rain, both = (
        along(hits(folder, tmp_path / "a", *sets))
        for sets in ([f"{FOLIAGE}0.5"], [f"{FOLIAGE}0", wet], [f"{FOLIAGE}0.5", wet])
    )
    clear = [*range(20), *range(28, 80)]  # within the crown the parts' chords, and so their ranges, are shorter
    np.testing.assert_allclose(both[clear], (dry * rain)[clear], atol=1e-9)
    behind = 10.0 + 30.25  # range of the middle of voxel 60
    loss = Rain(RainParameters(rate_mm_h=50)).detect(np.array([behind]), Sensor("s", (0.0,), (0.0,), 4, 100.0, ""))[0]
    assert both[60] == pytest.approx(math.exp(-1) * loss, abs=1e-9)


BAD = {
    f"{DIVERGENCE}5": "effects.divergence.sub_beams: 5",
    "effects.divergence.divergence_mrad=[-1, 2]": "effects.divergence.divergence_mrad.0: -1",
    "effects.divergence.divergence_mrad=[1]": "effects.divergence.divergence_mrad",
    "effects.divergence.subbeams=7": "Did you mean sub_beams",
    f"{SWAY}-1": "effects.mount_sway.tilt_deg: -1",
    f"{SWAY}nan": "effects.mount_sway.tilt_deg",
    "effects.mount_sway.samples=9": "effects.mount_sway.tilt_deg: this key is required",
    "effects.mount_sway={tilt_deg = 1, samples = 5}": "effects.mount_sway.samples: 5",
    f"{FOLIAGE}-0.1": "effects.foliage.leaf_area_density: -0.1",
    f"{FOLIAGE}inf": "effects.foliage.leaf_area_density",
    "effects.foliage.season='spring'": "effects.foliage.season",
    "effects.foliage.season=1.5": "effects.foliage.season",
    "effects.foliage.projection=0": "effects.foliage.projection: 0",
    "effects.foliage.step_m=0": "effects.foliage.step_m: 0",
}


@pytest.mark.parametrize("change", BAD)
def test_bad_parameters_are_refused(
    mini: Path, tmp_path: Path, run_egvs: Callable[..., tuple[int, str, str]], change: str
) -> None:
    code, _, err = run_egvs("scan", mini, "--out", tmp_path / "out", "--set", change)
    assert code == 2 and "Traceback" not in err
    assert BAD[change] in " ".join(err.split()).replace(" ", " ")


# --- what nobody can see


def test_what_no_beam_can_meet_is_left_out_and_the_bytes_stay(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(8)
    corners = rng.uniform([-200, -200], [240, 200], (150, 2))
    blocks = [prism(x, y, x + 3, y + 2, 0, 2 + i % 7, "building", f"b{i}") for i, (x, y) in enumerate(corners)]
    free = [
        b
        for b, (x, y) in zip(blocks, corners, strict=True)
        if math.hypot(x - 10, y - 12) > 9 and math.hypot(x - 30.5, y - 16) > 9
    ]
    place(mini, *free, sites="pole_a,10,12,3\npole_b,30.5,16,7\n")
    _, culled = scanned(mini, tmp_path / "a")
    held = []
    monkeypatch.setattr(
        ray_casting,
        "reachable_shapes",
        lambda shapes, *_: held.append(len(shapes)) or np.ones(len(shapes), dtype=np.bool_),
    )
    _, whole = scanned(mini, tmp_path / "b")
    assert files.hash_file(culled / "scans.parquet") == files.hash_file(whole / "scans.parquet")
    monkeypatch.undo()
    world, _ = read_ply(whole / "statics.ply")
    sites = np.array([[10, 12, 3], [30.5, 16, 7.0]])
    kept = ray_casting.reachable_shapes(world.triangles_m, egvs.load(mini).roi.box, sites, 100.0)
    assert 0.05 * held[0] < kept.sum() < 0.5 * held[0]


def test_reachable_and_between_never_leave_out_what_a_beam_meets() -> None:
    rng = np.random.default_rng(9)
    roi = Roi((0.0, 0.0, 0.0), (10.0, 6.0, 4.0))
    for _ in range(30):
        sites = rng.uniform([-15, -15, 1], [25, 25, 12], (3, 3))
        start, through = sites[rng.integers(3, size=200)], rng.uniform([0, 0, 0], [10, 6, 4], (200, 3))
        far = rng.uniform(0, 6, 200)[:, None]
        met = start + far * (through - start)
        shapes = met[:, None] + rng.normal(0, 0.5, (200, 3, 3))
        shapes[:, 0] = met
        assert ray_casting.reachable_shapes(shapes, roi, sites, float(np.linalg.norm(met - start, axis=1).max())).all()
        assert ray_casting.shapes_between(shapes[far[:, 0] <= 1], roi, sites).all()


def test_without_static_geometry_in_reach_no_tree_is_built(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_casting, "TriangleTree", lambda triangles: pytest.fail("a tree was built"))
    for number, standing in enumerate(((), (prism(5, 60, 9, 70, 0, 9, "building"),))):
        _, out = scanned(
            place(mini, *standing, sites="pole_a,10,12,3\n"), tmp_path / str(number), "statics.ground=false"
        )
        table, _ = parquet.read_artefact(out / "scans.parquet", "scans")
        assert table.num_rows > 0 and not any(table.column("returned").to_pylist())


def test_a_caster_that_knows_no_sites_holds_everything() -> None:
    world = _world(*CROWNS)
    assert len(Caster(world, ROI)._triangles) == len(world.faces)


def test_idle_looks_at_simulated_sites_only(mini: Path) -> None:
    scene = egvs.build_scene(egvs.load(place(mini, *TREES)))
    assert Foliage(FoliageParameters()).why_idle(scene) is None
    assert Divergence(DivergenceParameters()).why_idle(scene) is None
    assert MountSway(MountSwayParameters(tilt_deg=1)).why_idle(scene) is None
