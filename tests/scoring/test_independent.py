"""Does a program that shares no code with the pipeline find the same numbers, voxel by voxel?

It reads the scenario's TOML and CSV, ``trajectories.parquet`` and ``statics.ply`` with its own few lines; lays out the
beams from the maker's table; holds each beam against all triangles in float64; collects and sorts the crossings of each
segment with the grid's planes; finds occupancy with separating axes frame by frame; and adds up entropies from
logarithms. Hits and counts must be equal, not nearly equal. Then the whole scene is moved by 4,000 km: the same bits
must come out."""

import csv
import json
import math
import tomllib
from itertools import pairwise
from pathlib import Path

import numba
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import trimesh

from egvs.scenario import loading
from egvs.stages import scan, score, statics, tpog, traffic
from egvs.world.mesh import World, read_ply, write_ply
from tests.oracles import cast
from tests.stage_runner import run_stage

pytestmark = [pytest.mark.system, pytest.mark.slow]  # SUMO makes the traffic

SHORT = ("traffic.frames=60", "tpog.blocks=3", "traffic.frame_period_s=1")
SITES = {"nishishinjuku": "c05", "ingolstadt": "k02"}
ALSO = {"nishishinjuku": "c13", "ingolstadt": "k08"}
"""The first is recomputed from nothing; of both, the scores are."""
RANKED_BY = {"nishishinjuku": "expected_detections", "ingolstadt": "egvs"}

# Velodyne VLP-32C User Manual, 63-9325: elevation and azimuth offset of each laser, in firing order.
LASERS = """
-25 1.4, -1 -4.2, -1.667 1.4, -15.639 -1.4, -11.31 1.4, 0 -1.4, -0.667 4.2, -8.843 -1.4, -7.254 1.4, 0.333 -4.2,
-0.333 1.4, -6.148 -1.4, -5.333 4.2, 1.333 -1.4, 0.667 4.2, -4 -1.4, -4.667 1.4, 1.667 -4.2, 1 1.4, -3.667 -4.2,
-3.333 4.2, 3.333 -1.4, 2.333 1.4, -2.667 -1.4, -3 1.4, 7 -1.4, 4.667 1.4, -2.333 -4.2, -2 4.2, 15 -1.4, 10.333 1.4,
-1.333 -1.4"""
RANGE_M = 200.0


def load(name):
    return loading.load(
        f"scenarios/{name}",
        [*SHORT, "effects.range_limit=false", f'score.keep_visibility=["{SITES[name]}", "{ALSO[name]}"]'],
    )


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Each shipped scenario, a short run of all its stages."""
    folders = {}
    for name in SITES:
        folders[name] = tmp_path_factory.mktemp(name)
        loaded = load(name)
        for stage in (traffic, statics, tpog, scan, score):
            run_stage(stage, loaded, folders[name])
    return folders


class Scene:
    """What a scenario's files say, read on its own."""

    def __init__(self, name):
        folder = Path("scenarios") / name
        values = tomllib.loads((folder / "scenario.toml").read_text())
        self.voxel = values["roi"].get("voxel_m", 0.25)
        centre, size = np.array(values["roi"]["center_m"]), np.array(values["roi"]["size_m"])
        self.origin, self.shape = centre - size / 2, np.round(size / self.voxel).astype(np.int64)
        self.gamma = values.get("score", {}).get("gamma", 2)  # what "auto" is for voxels of 0.25 m
        with (folder / "sites.csv").open() as file:
            self.sites = {row["site"]: row for row in csv.DictReader(file)}


def triangles_of(folder):
    mesh = trimesh.load(folder / "statics.ply", process=False)
    return np.asarray(mesh.vertices)[np.asarray(mesh.faces)]


def sine(micro_degrees):
    """Sine of whole millionths of a degree, exact at quarter turns."""
    quarter, rest = np.divmod(np.asarray(micro_degrees, dtype=np.int64), 90_000_000)
    angle = np.deg2rad(rest / 1e6)
    return np.choose(quarter % 4, [np.sin(angle), np.cos(angle), -np.sin(angle), -np.cos(angle)]) + 0.0


def cosine(micro_degrees):
    return sine(np.asarray(micro_degrees, dtype=np.int64) + 90_000_000)


def beams_of(yaw_deg):
    """Directions of the VLP-32C's beams, 1800 steps of 0.2 degrees, upright."""
    elevation, offset = (
        np.array(v, dtype=np.float64) for v in zip(*(laser.split() for laser in LASERS.split(",")), strict=True)
    )
    elevation, offset = (np.rint(v * 1e6).astype(np.int64) for v in (elevation, offset))
    azimuth = (np.arange(1800)[:, None] * 200_000 + offset + round(yaw_deg * 1e6)).reshape(-1)
    elevation = np.tile(elevation, 1800)
    return np.column_stack([cosine(elevation) * cosine(azimuth), cosine(elevation) * sine(azimuth), sine(elevation)])


def meets(start, ways, size):
    """Which segments come into the box [0, size], or near it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = -start / ways, (size - start) / ways
    first, last = np.fmin(low, high), np.fmax(low, high)
    return np.maximum(first.max(axis=1), 0.0) <= np.minimum(last.min(axis=1), 1.0)


def hits_of(scene, folder, site):
    """Beams of a site that cross each voxel."""
    row = scene.sites[site]
    assert row["sensor"] == "VLP-32C"
    assert float(row["pitch_deg"]) == float(row["roll_deg"]) == 0.0
    position, ways = np.array([float(row[key]) for key in ("x_m", "y_m", "z_m")]), beams_of(float(row["yaw_deg"]))
    ways = ways[meets(position - scene.origin, RANGE_M * ways, scene.shape * scene.voxel)]
    ranges, _ = cast.first_hits(position - scene.origin, ways, triangles_of(folder) - scene.origin)
    ends = ways * np.minimum(ranges, RANGE_M)[:, None]
    return cast.count_hits(position, ends, scene.origin, scene.voxel, scene.shape)


def visible_of(folder, site, shape):
    table = pq.read_table(folder / "visibility.parquet").filter(pa.compute.field("site") == site)
    found = np.zeros(shape)
    found[tuple(table[axis].to_numpy() for axis in ("ix", "iy", "iz"))] = table["hits"].to_numpy()
    return found


def counts_of(folder, shape):
    """Counts of each block, (blocks, nx, ny, nz)."""
    table = pq.read_table(folder / "tpog.parquet")
    found = np.zeros((3, *shape), dtype=np.int64)
    found[tuple(table[axis].to_numpy() for axis in ("block", "ix", "iy", "iz"))] = table["count"].to_numpy()
    return found


@numba.njit(cache=True)
def _occupy(boxes, voxel, shape, occupied):
    """Mark the voxels that share volume with upright boxes (x, y, z, yaw, length, width, height): separating axes."""
    for b in range(boxes.shape[0]):
        x, y, z, yaw, length, width, height = boxes[b]
        a, w, h = 0.5 * length - 1e-4, 0.5 * width - 1e-4, 0.5 * height - 1e-4
        c, s = math.cos(yaw), math.sin(yaw)
        reach = math.hypot(a, w)
        for i in range(max(0, int((x - reach) // voxel)), min(shape[0], int((x + reach) // voxel) + 1)):
            for j in range(max(0, int((y - reach) // voxel)), min(shape[1], int((y + reach) // voxel) + 1)):
                dx, dy, half = (i + 0.5) * voxel - x, (j + 0.5) * voxel - y, 0.5 * voxel
                span = half * (abs(c) + abs(s))
                if abs(dx) >= half + a * abs(c) + w * abs(s) or abs(dy) >= half + a * abs(s) + w * abs(c):
                    continue
                if abs(dx * c + dy * s) >= a + span or abs(dy * c - dx * s) >= w + span:
                    continue
                for k in range(shape[2]):
                    if (k + 1) * voxel > z - h and k * voxel < z + h:
                        occupied[i, j, k] = True


@numba.njit(cache=True)
def _clipped(triangle, low, high):
    """Whether a triangle, cut by the six planes of a box one after the other, keeps a point inside."""
    points, count = np.zeros((16, 3)), 3
    points[:3] = triangle
    for axis in range(3):
        for side in (1.0, -1.0):
            bound = low[axis] if side > 0 else -high[axis]
            kept, n = np.zeros((16, 3)), 0
            for p in range(count):
                here, there = points[p], points[(p + 1) % count]
                depth, next_depth = side * here[axis] - bound, side * there[axis] - bound
                if depth > 0:
                    kept[n] = here
                    n += 1
                if (depth > 0) != (next_depth > 0):
                    kept[n] = here + (there - here) * (depth / (depth - next_depth))
                    n += 1
            points, count = kept, n
            if count == 0:
                return False
    return True


@numba.njit(cache=True)
def _solid_angle(triangles, p):
    """Sum of the triangles' solid angles from p (van Oosterom and Strackee 1983), in whole spheres."""
    total = 0.0
    for m in range(triangles.shape[0]):
        a, b, c = triangles[m, 0] - p, triangles[m, 1] - p, triangles[m, 2] - p
        la, lb, lc = math.sqrt((a * a).sum()), math.sqrt((b * b).sum()), math.sqrt((c * c).sum())
        top = (a * np.cross(b, c)).sum()
        total += math.atan2(top, la * lb * lc + (a * b).sum() * lc + (b * c).sum() * la + (c * a).sum() * lb)
    return total / (2 * math.pi)


def is_static(triangles, solids, scene, cell):
    """Whether static geometry reaches deeper than 0.1 mm into a voxel, or a closed solid holds it whole."""
    low, high = np.array(cell) * scene.voxel, (np.array(cell) + 1) * scene.voxel
    near = ((triangles.max(axis=1) > low + 1e-4) & (triangles.min(axis=1) < high - 1e-4)).all(axis=1)
    if any(_clipped(t, low + 1e-4, high - 1e-4) for t in triangles[near]):
        return True
    middle = 0.5 * (low + high)
    return any(
        abs(_solid_angle(triangles[first:last], middle)) > 0.5
        for first, last, bottom, top in solids
        if (bottom < middle).all() and (middle < top).all()
    )


def solids_of(triangles, names):
    """First and last triangle and bounds of each closed solid (here: all but the ground)."""
    edges = np.append(np.flatnonzero(np.diff(names, prepend=-1)), len(names))
    pairs = [(int(a), int(b)) for a, b in pairwise(edges) if b - a > 2]
    return [(a, b, triangles[a:b].min(axis=(0, 1)), triangles[a:b].max(axis=(0, 1))) for a, b in pairs]


@pytest.mark.parametrize("name", sorted(SITES))
def test_hits_of_every_voxel(runs, name):
    scene = Scene(name)
    found = visible_of(runs[name], SITES[name], scene.shape)
    true = hits_of(scene, runs[name], SITES[name])
    assert true.sum() > 300_000
    assert np.array_equal(found, true)


@pytest.mark.parametrize("name", sorted(SITES))
def test_counts_of_every_voxel(runs, name):
    scene = Scene(name)
    table = pq.read_table(runs[name] / "trajectories.parquet")
    boxes = np.column_stack(
        [table[key].to_numpy() for key in ("x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")]
    )
    boxes[:, :3] -= scene.origin
    assert (table["pitch_rad"].to_numpy() == 0).all()
    frame, true = table["frame"].to_numpy(), np.zeros((3, *scene.shape), dtype=np.int64)
    for f in range(60):
        occupied = np.zeros(scene.shape, dtype=np.bool_)
        _occupy(np.ascontiguousarray(boxes[frame == f]), scene.voxel, scene.shape, occupied)
        true[f // 20] += occupied
    found = counts_of(runs[name], scene.shape)
    world, _ = read_ply(runs[name] / "statics.ply")
    triangles = world.triangles_m - scene.origin
    solids = solids_of(triangles, world.solid_of_face)
    differ = {tuple(int(v) for v in cell) for cell in np.argwhere((found != true).any(axis=0))}
    for cell in differ:  # left out because something stands there
        assert (found[:, *cell] == 0).all()
        assert is_static(triangles, solids, scene, cell)
    kept = np.argwhere(found.any(axis=0))
    for cell in kept[:: max(1, len(kept) // 400)]:
        assert not is_static(triangles, solids, scene, tuple(cell))
    assert found.sum() > 100_000


def entropy(count, frames):
    p = count / frames
    return 0.0 if count in (0, frames) else -(p * math.log(p) + (1 - p) * math.log1p(-p)) / math.log(2)


@pytest.mark.parametrize("name", sorted(SITES))
def test_score(runs, name):
    scene = Scene(name)
    counts = counts_of(runs[name], scene.shape).sum(axis=0)
    uncertain = (counts > 0) & (counts < 60)
    weights = np.array([entropy(c, 60) for c in range(61)])[counts[uncertain]]
    rows = pq.read_table(runs[name] / "scores.parquet").to_pylist()
    for row in rows:
        assert row["egvs_limit"] == pytest.approx(scene.gamma * math.fsum(weights), rel=1e-12)
        assert row["rank"] == 1 + sum(other[RANKED_BY[name]] > row[RANKED_BY[name]] for other in rows)
        if row["site"] in (SITES[name], ALSO[name]):
            hits = visible_of(runs[name], row["site"], scene.shape)[uncertain]
            egvs = math.fsum(weights * np.minimum(hits, scene.gamma))
            assert row["egvs"] == pytest.approx(egvs, rel=1e-12)
            assert row["entropy_seen"] == pytest.approx(math.fsum(weights[hits > 0]) / math.fsum(weights), rel=1e-12)
    assert min(row["egvs"] for row in rows) > 0


def moved_run(folder, shift):
    """nishishinjuku without its ground plane, every coordinate a multiple of 2**-16 m, moved by ``shift``; its hits and
    scores."""
    folder.mkdir()
    source = Path("scenarios/nishishinjuku")
    loaded = load("nishishinjuku")
    values = json.loads(loaded.model_dump_json(exclude_unset=True))
    values["roi"]["center_m"] = [float(c) for c in np.array(values["roi"]["center_m"]) + shift]
    values["statics"] = {"ground": False}
    values["score"]["blindspots"] = False  # lanes of a network that is not moved
    with (source / "sites.csv").open() as file:
        rows = list(csv.reader(file))
    for row in rows[1:]:
        row[1:4] = [repr(float(v) + float(s)) for v, s in zip(row[1:4], shift, strict=True)]
    (folder / "sites.csv").write_text("".join(",".join(row) + "\n" for row in rows))
    return folder, loading.scenario_from_dict(values, folder, "moved")


def test_a_scene_moved_by_4000_km_gives_the_same_bits(runs, tmp_path):
    source, found = runs["nishishinjuku"], []
    world, about = read_ply(source / "statics.ply")
    kept = world.solid_of_face < len(world.solids) - 1  # z moves too: the ground plane at 0 would not
    table = pq.read_table(source / "trajectories.parquet")
    schema = table.schema.with_metadata({b"egvs": pq.read_metadata(source / "trajectories.parquet").metadata[b"egvs"]})
    for number, shift in enumerate(
        np.array([[0.0, 0.0, 0.0], [393216.0, 3932160.0, 64.0], [-393216.0, 3932160.0, -32.0]])
    ):
        folder, loaded = moved_run(tmp_path / str(number), shift)
        vertices = np.round(world.vertices_m * 2**16) / 2**16
        write_ply(
            folder / "statics.ply",
            World(vertices + shift, world.faces[kept], world.solid_of_face[kept], world.solids[:-1]),
            about,
        )
        columns = {name: table[name] for name in table.column_names}
        for axis, by in zip(("x_m", "y_m", "z_m"), shift, strict=True):
            columns[axis] = pa.array(np.round(table[axis].to_numpy() * 2**16) / 2**16 + by)
        pq.write_table(pa.table(columns, schema=schema), folder / "trajectories.parquet")
        for stage in (tpog, scan, score):
            run_stage(stage, loaded, folder)
        scores = ["site", "egvs", "egvs_limit", "rank", "entropy_seen", "returns"]
        kept_columns = {"tpog": None, "visibility": None, "scans": None, "scores": scores}
        found.append(
            {name: pq.read_table(folder / f"{name}.parquet", columns=keys) for name, keys in kept_columns.items()}
        )
    for moved in found[1:]:
        for name, here in found[0].items():
            assert here.num_rows == moved[name].num_rows > 0
            assert here.equals(moved[name]), name
