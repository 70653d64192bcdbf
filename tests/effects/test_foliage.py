"""Foliage."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
import shapely

from egvs.artefacts import parquet
from egvs.effects.foliage import Foliage
from egvs.scenario.effects_config import FoliageParameters
from egvs.sensors.sites import Pose
from egvs.world.mesh import World
from egvs.world.ray_casting import EmptyScan
from tests.effects.scan_helpers import (
    CROWNS,
    DIVERGENCE,
    FOLIAGE,
    HOOK,
    ROI,
    TREES,
    _world,
    hits_along_only_beam,
    one_beam_scene,
    prism,
    run_scan,
    scan_hits,
    write_scene,
)

OPAQUE = 1e15


# --- foliage
@pytest.mark.slow
def test_transmittance_follows_beer_lambert(mini: Path, tmp_path: Path) -> None:
    """A crown 4 m deep, from x = 10 to 14; G x LAD = 0.5 x 0.5 = 0.25 a metre: exp(-1) = 0.3679 gets through.

    Steps of 0.5 m begin where voxels begin, so a voxel's hits are what reaches its front: exp(-0.25 (x - 10))."""
    folder = one_beam_scene(mini, prism(10, -2, 14, 2, 1, 5, "tree_crown"))
    result = hits_along_only_beam(scan_hits(folder, tmp_path / "a", f"{FOLIAGE}0.5", "effects.foliage.step_m=0.5"))
    x = 0.5 * np.arange(80)
    np.testing.assert_allclose(result, np.exp(-0.25 * np.clip(x - 10, 0, 4)), atol=2**-32)
    table, metadata = parquet.read_artefact(tmp_path / "a" / "scans.parquet", "scans")
    assert table.column("weight").to_pylist()[-1] == pytest.approx(math.exp(-1), abs=1e-9)
    assert table.column("returned").to_pylist() == [True] * 8 + [False]
    assert (metadata["sites"][0]["beams_in_roi"], metadata["sites"][0]["returns"]) == (1, 1)


@pytest.mark.parametrize(
    ("season", "share"), [("'summer'", 1.0), ("'autumn'", 0.7), ("'winter'", 0.35), ("0.125", 0.125)]
)
def test_seasons(mini: Path, tmp_path: Path, season: str, share: float) -> None:
    folder = one_beam_scene(mini, prism(10, -2, 14, 2, 1, 5, "tree_crown"))
    result = hits_along_only_beam(
        scan_hits(folder, tmp_path / "a", f"{FOLIAGE}0.5", f"effects.foliage.season={season}")
    )
    assert result[-1] == pytest.approx(math.exp(-share), abs=2**-32)


def test_overlapping_crowns_add_up_and_opaque_surfaces_end_beams(mini: Path, tmp_path: Path) -> None:
    """k = 0.25: 4 m in one crown and 3 m in the other: exp(-7/4) reaches the wall at x = 20; nothing reaches x = 21."""
    crowns = prism(10, -2, 14, 2, 1, 5, "tree_crown", "a"), prism(12, -3, 15, 3, 0, 4, "tree_crown", "b")
    folder = one_beam_scene(mini, *crowns, prism(20.2, -2, 21, 2, 0, 5, "building"))
    result = hits_along_only_beam(scan_hits(folder, tmp_path / "a", f"{FOLIAGE}0.5"))
    assert result[30:41] == pytest.approx(math.exp(-7 / 4), abs=2**-31)
    assert not result[41:].any()


@pytest.mark.parametrize("step", [0.05, 0.3, 7.0])
def test_step_changes_hits_only_within_crowns(mini: Path, tmp_path: Path, step: float) -> None:
    folder = one_beam_scene(mini, prism(10.3, -2, 13.1, 2, 1, 5, "tree_crown"))
    result = hits_along_only_beam(scan_hits(folder, tmp_path / "a", f"{FOLIAGE}0.5", f"effects.foliage.step_m={step}"))
    assert result[:21] == pytest.approx(1)
    assert result[27:] == pytest.approx(math.exp(-0.7), abs=2**-32)
    exact = np.exp(-0.25 * np.clip(0.5 * np.arange(80) - 10.3, 0, 2.8))
    assert np.abs(result - exact).max() < 0.25 * min(step, 2.8)


def test_denser_leaves_never_raise_hits_and_become_opaque(mini: Path, tmp_path: Path) -> None:
    folder = write_scene(mini, *TREES)
    plain_scan_run = scan_hits(folder, tmp_path / "plain")
    result = [scan_hits(folder, tmp_path / "a", f"{FOLIAGE}{density}") for density in (0, 0.2, 1, 5, 1e3, OPAQUE)]
    for site in plain_scan_run:
        series = [f[site] for f in result]
        assert all((more <= less).all() for less, more in itertools.pairwise(series))
        assert series[0].sum() > series[1].sum() > series[2].sum() > series[3].sum() > plain_scan_run[site].sum()
        np.testing.assert_array_equal(series[-1], plain_scan_run[site])


def test_densest_leaves_give_the_plain_scan(mini: Path, tmp_path: Path) -> None:
    folder = write_scene(mini, *TREES)
    _, plain_scan_run = run_scan(folder, tmp_path / "plain")
    _, dense = run_scan(folder, tmp_path / "dense", f"{FOLIAGE}{OPAQUE}")
    (before, metadata), (after, about_after) = (
        parquet.read_artefact(out / "scans.parquet", "scans") for out in (plain_scan_run, dense)
    )
    for name in ("site", "beam", "returned"):
        assert before.column(name) == after.column(name)
    for name in ("dx_m", "dy_m", "dz_m"):
        np.testing.assert_allclose(
            after.column(name).to_numpy(), before.column(name).to_numpy(), rtol=1e-12, atol=1e-12
        )
    assert set(after.column("weight").to_pylist()) == {1.0}
    assert metadata["sites"] == about_after["sites"]


def _lengths(position: np.ndarray, ends: np.ndarray) -> list[float]:
    """Metres within crowns of each beam, by clipping its footprint with shapely."""
    result = []
    for end in ends:
        total = 0.0
        for ring, base, top in CROWNS:
            low, high = sorted(((z - position[2]) / end[2]) for z in (base, top)) if end[2] else (0.0, 1.0)
            low, high = max(low, 0.0), min(high, 1.0)
            if low < high and (end[2] or base < position[2] < top):
                line = shapely.LineString([(position + t * end)[:2] for t in (low, high)])
                flat = shapely.Polygon(ring).intersection(line).length
                total += flat * math.sqrt((end**2).sum()) / math.hypot(end[0], end[1])
        result.append(total)
    return result


def _cut(position: np.ndarray, ends: np.ndarray, **parameters: float) -> EmptyScan:
    cut = Foliage(FoliageParameters(**parameters)).cutter(_world(*CROWNS), ROI)
    beams = EmptyScan(np.arange(len(ends), dtype=np.uint32), ends, np.zeros(len(ends), dtype=np.bool_))
    return cut(beams, Pose(*position))


def test_lengths_within_crowns_agree_with_reference() -> None:
    rng = np.random.default_rng(5)
    for position in (np.array([-5.0, 2.0, 3.0]), np.array([13.0, 1.0, 3.0]), np.array([18.0, -9.0, 6.5])):
        ends = rng.uniform([0, -10, 0], [40, 10, 5], (400, 3)) - position
        result = _cut(position, ends, leaf_area_density=0.2, step_m=0.7)
        share = np.zeros(400)
        np.add.at(share, result.beam, result.weight)
        assert share.tolist() == [1.0] * 400
        goes_on = np.zeros(400)
        goes_on[result.beam[~result.returned]] = result.weight[~result.returned]
        np.testing.assert_allclose(goes_on, np.exp(-0.1 * np.array(_lengths(position, ends))), atol=2e-7)
        assert (np.diff(result.beam.astype(np.int64)) >= 0).all()


def test_parts_end_within_crowns_on_their_beam() -> None:
    position = np.array([-5.0, 2.0, 3.0])
    ends = np.random.default_rng(6).uniform([30, -10, 0], [40, 10, 5], (200, 3)) - position
    result = _cut(position, ends, leaf_area_density=3.0)
    complete = ends[result.beam]
    np.testing.assert_allclose(np.cross(result.ends_m, complete), 0, atol=1e-10)
    where = position + result.ends_m[result.returned]
    inside = np.zeros(len(where), dtype=bool)
    for ring, base, top in CROWNS:
        near = shapely.Polygon(ring).buffer(1e-6)
        inside |= (
            shapely.contains_xy(near, where[:, 0], where[:, 1])
            & (where[:, 2] > base - 1e-6)
            & (where[:, 2] < top + 1e-6)
        )
    assert len(where) > 300 and inside.all()


def test_beams_through_edges_and_corners_and_along_faces() -> None:
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
        result = cut(beam, Pose(*start))
        assert result.weight[~result.returned].sum() == pytest.approx(math.exp(-0.25 * length), abs=3e-7), name


def test_open_crown_is_opaque() -> None:
    complete = _world((HOOK, 1.0, 4.0))
    open_ = World(complete.vertices_m, complete.faces[1:], complete.solid_of_face[1:], complete.solids)
    effect = Foliage(FoliageParameters())
    assert len(effect.opaque(complete).faces) == 0 and len(effect.opaque(open_).faces) == len(open_.faces)


def test_foliage_does_not_depend_on_the_position_of_the_scene(mini: Path, tmp_path: Path) -> None:
    shift = np.array([2.0**18, 2.0**22])
    here = scan_hits(write_scene(mini, *TREES), tmp_path / "a", f"{FOLIAGE}1", f"{DIVERGENCE}7")
    x, y = shift
    far = json.loads((mini / "statics.geojson").read_text())
    for item in far["features"]:
        item["geometry"]["coordinates"] = (np.array(item["geometry"]["coordinates"]) + shift).tolist()
    (mini / "statics.geojson").write_text(json.dumps(far))
    (mini / "sites.csv").write_text(f"site,x_m,y_m,z_m\npole_a,{10 + x},{12 + y},3\npole_b,{30.5 + x},{y - 12},3\n")
    there = scan_hits(mini, tmp_path / "b", f"{FOLIAGE}1", f"{DIVERGENCE}7", f"roi.center_m=[{20 + x}, {y}, 2.5]")
    for site, result in here.items():
        np.testing.assert_array_equal(result, there[site])
