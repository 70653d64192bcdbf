"""Does a scene that is moved by tenths of a metre keep every hit and every score, in voxels of 0.1, 0.2 and 0.3 m?"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import egvs
from egvs.artefacts.tpog import read_tpog
from egvs.core.grid import PLANE_TOLERANCE_M, Grid
from egvs.kernels import traversal
from egvs.scoring.scorer import Scorer
from egvs.sensors.scanner import Scanner
from egvs.stages import statics, tpog, traffic
from tests.conftest import collection, feature
from tests.stage_runner import run_stage

SCENARIO = """\
[roi]
center_m = [{x}, {y}, 0.9]
size_m = [9, 6, 1.8]
voxel_m = {voxel}

[traffic]
fcd = "fcd.csv"
frames = 20
frame_period_s = 0.5
warmup_s = 0

[[traffic.kinds]]
name = "car"
length_m = 4.2
width_m = 1.8
height_m = 1.5

[statics]
footprints = ["statics.geojson"]

[tpog]
blocks = 2

[sites]
file = "sites.csv"
sensor = "small"

[sensors.small]
elevations_deg = [-20, -5, 0, 10]
azimuth_step_deg = 5.0
range_m = 60

[score]
gamma = 4
"""


def moved(tenths: int, at: float) -> float:
    """The decimal that a person writes for a place that is some tenths of a metre further on."""
    return float(Fraction(repr(at)) + Fraction(tenths, 10))


def scored(folder: Path, voxel: float, k: int) -> tuple[Any, list[np.ndarray], list[float]]:
    """TPOG counts, hits and scores of a scene that is moved by k tenths along x and 3 k along y."""
    folder.mkdir()
    x, y = (lambda at: moved(k, at)), (lambda at: moved(3 * k, at))
    corners = [[x(a), y(b)] for a, b in ((3.3, 1.2), (4.2, 1.2), (4.2, 2.1), (3.3, 2.1), (3.3, 1.2))]
    wall = feature({"type": "Polygon", "coordinates": [corners]}, name="wall", kind="building", height_m=1.2)
    (folder / "statics.geojson").write_text(collection(wall))
    # On planes of 0.3 m, in a plane of the region's face, next to one, and off all of them.
    sites = [(0.3, 2.7, 0.9), (6.6, -3.0, 0.6), (8.7, 2.4, 1.8), (4.37, -2.13, 1.55)]
    rows = [f"s{i},{x(a)!r},{y(b)!r},{c}" for i, (a, b, c) in enumerate(sites)]
    (folder / "sites.csv").write_text("\n".join(["site,x_m,y_m,z_m", *rows]) + "\n")
    lines = ["timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type;vehicle_speed"]
    for frame in range(20):  # sides on planes, and 0.1 mm beyond one
        lines.append(f"{frame / 2:.2f};a;{x(round(0.3 * frame, 1))!r};{y(-0.9)!r};90.0;car;1.0")
        lines.append(f"{frame / 2:.2f};b;{x(round(9.0001 - 0.3 * frame, 4))!r};{y(0.0001)!r};270.0;car;1.0")
    (folder / "fcd.csv").write_text("\n".join(lines) + "\n")
    (folder / "scenario.toml").write_text(SCENARIO.format(x=x(4.5), y=y(0.0), voxel=voxel))
    scenario, out = egvs.load(folder), folder / "out"
    out.mkdir()
    for stage in (statics, traffic, tpog):
        run_stage(stage, scenario, out)
    counted, scene = read_tpog(out / "tpog.parquet"), egvs.build_scene(scenario)
    scanner, scorer = Scanner(scene), Scorer(scene, counted)
    worth = [scorer.score_and_hits(scanner.scan_site(site)) for site in scene.sites]
    return counted.counts, [hits for _, hits in worth], [score.egvs for score, _ in worth]


@pytest.mark.parametrize("voxel", [0.1, 0.2, 0.3])
def test_moved_by_tenths_of_a_metre_every_hit_and_score_stays(tmp_path: Path, voxel: float) -> None:
    counts, hits, scores = scored(tmp_path / "here", voxel, 0)
    assert min(scores) > 0 and counts.any()
    for k in (1, 7, 12345):
        other = scored(tmp_path / f"moved by {k}", voxel, k)
        assert np.array_equal(counts, other[0])
        assert all(np.array_equal(mine, theirs) for mine, theirs in zip(hits, other[1], strict=True))
        assert scores == other[2]


@pytest.mark.parametrize(("tenths", "plane"), [(1, 3), (2, 3), (3, 1), (3, 7)])
def test_a_beam_in_a_plane_belongs_to_the_voxel_that_begins_there(tenths: int, plane: int) -> None:
    """Half-open voxels: x = 0.3 m is the first of voxel 3 of 0.1 m, wherever the scene lies."""
    for k in range(-300, 300, 7):
        grid = Grid((moved(k, 0.0), 0.0, 0.0), tenths / 10, (10, 10, 10))
        site = (moved(k + plane * tenths, 0.0), 0.05, 0.05)
        for off in (0.0, 0.9 * PLANE_TOLERANCE_M, -0.9 * PLANE_TOLERANCE_M):
            o, d = grid.segments((site[0] + off, *site[1:]), np.array([[0.0, tenths * 0.8, 0.0], [off, 0.0, 0.5]]))
            assert (o[0], d[0, 0], d[1, 0]) == (plane, 0.0, 0.0)
            hits = np.zeros(1000, dtype=np.uint32)
            traversal.count_hits(o, d, np.array(grid.shape), grid.voxel_m, hits)
            assert set(np.nonzero(hits.reshape(grid.shape))[0]) == {plane}


def test_points_more_than_a_nanometre_from_a_plane_stay_off_it() -> None:
    grid = Grid((0.0, 0.0, 0.0), 0.1, (10, 10, 10))
    o, d = grid.segments((0.3 - 1.1e-9, 0.05, 0.2), np.array([[1e-9, 1.0, 1.1e-9], [0.0, 1.0, -1e-9]]))
    assert o[0] < 3 and o[2] == 2
    assert d[:, 0].tolist() == [1e-9 / 0.1, 0.0] and d[:, 2].tolist() == [1.1e-9 / 0.1, 0.0]


def test_voxels_of_a_quarter_take_every_bit_as_before() -> None:
    rng = np.random.default_rng(5)
    grid = Grid((145.0, 205.0, 0.0), 0.25, (400, 200, 20))
    sites = rng.integers(-4096, 4096, (50, 3)) / 64 + grid.origin_m
    ends = rng.normal(size=(20, 3))
    for site in sites:
        o, d = grid.segments(tuple(site), ends)
        assert o.tolist() == ((site - grid.origin_m) / 0.25).tolist()
        assert d.tolist() == (ends / 0.25).tolist()
