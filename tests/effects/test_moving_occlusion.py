"""Moving occlusion, compared with a brute-force count.

The twin below shares no code with the effect: half-spaces from rotation matrices instead of slabs, every voxel of the
grid instead of a march, every box for every beam. It must find the same whole numbers."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from benchmarks import occlusion as benchmark
from scipy.spatial.transform import Rotation
from scipy.special import cosdg, sindg

import egvs
from egvs.artefacts import parquet
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.grid import Grid, Roi
from egvs.effects import moving_occlusion
from egvs.effects.rain import Rain
from egvs.scenario.effects_config import MovingOcclusionParameters, RainParameters
from egvs.scoring.visibility import UNIT, Beams, HitCounter
from egvs.sensors import voxel_crossings
from egvs.sensors.sites import Pose
from egvs.stages import score
from tests.stage_runner import inputs_of, run_stage

ON = "effects.moving_occlusion.method=frames"
ALL = "effects.moving_occlusion.frames=all"
INDEPENDENT = "effects.moving_occlusion.method=independent"
GRID = Grid.over(Roi((0.0, -5.0, 0.0), (20.0, 10.0, 5.0)), 0.5)
WIDE = Grid.over(Roi((0.0, 0.0, 0.0), (80.0, 80.0, 80.0)), 1.0)
SHRINK, CHORD = 1e-4 + 1e-9, 1e-6


# Reference implementation


def reference_ranges(o: np.ndarray, d: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Range (n,) at which rays from ``o`` with unit directions ``d`` enter the first of ``boxes`` (m, 8): six
    half-spaces each."""
    first = np.full(len(d), np.inf)
    for x, y, z, yaw, pitch, *size in boxes:
        about_z = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
        about_y = np.array([[math.cos(pitch), 0, -math.sin(pitch)], [0, 1, 0], [math.sin(pitch), 0, math.cos(pitch)]])
        forward_left_up = (about_z @ about_y).T
        normals = np.vstack([forward_left_up, -forward_left_up])
        away = normals @ (o - [x, y, z]) - (np.array(size + size) / 2 - SHRINK)  # > 0: the sensor is outside this face
        if (away < 0).all():
            continue
        t_in, t_out = np.zeros(len(d)), np.full(len(d), np.inf)
        for rate, a in zip(normals @ d.T, away, strict=True):
            with np.errstate(divide="ignore", invalid="ignore"):
                t = -a / rate
            t_in = np.where(rate < 0, np.fmax(t_in, t), t_in)
            t_out = np.where(rate > 0, np.fmin(t_out, t), t_out)
            t_out = np.where((rate == 0) & (a >= 0), -np.inf, t_out)
        first = np.where(t_in < t_out, np.fmin(first, t_in), first)
    return first


def reference_crossings(o: np.ndarray, end: np.ndarray, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Flat voxels that a segment crosses and the ranges of entry, sorted by range; tests every voxel of the grid."""
    length = math.sqrt((end**2).sum())
    corner = (
        np.stack(np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij"), axis=-1).reshape(-1, 3) * grid.voxel_m
    )
    t0, t1 = np.zeros(len(corner)), np.full(len(corner), 1.0)
    for a in range(3):
        low, high = corner[:, a] - o[a], corner[:, a] + grid.voxel_m - o[a]
        if end[a] == 0:
            t1[~((low <= 0) & (high > 0))] = -1
        else:
            t0, t1 = (
                np.maximum(t0, np.minimum(low / end[a], high / end[a])),
                np.minimum(t1, np.maximum(low / end[a], high / end[a])),
            )
    met = np.flatnonzero((t1 - t0) * length > CHORD)
    order = np.argsort(t0[met], kind="stable")
    return met[order], t0[met][order] * length


def reference_blocked(
    o: np.ndarray, ends: np.ndarray, first: np.ndarray, enter: np.ndarray, frames: dict[int, np.ndarray]
) -> np.ndarray:
    """Frames in which each crossing is not reached."""
    beam = np.repeat(np.arange(len(ends)), np.diff(first))
    directions = ends / np.sqrt((ends**2).sum(axis=1))[:, None]
    blocked = np.zeros(len(enter), dtype=np.int64)
    for boxes in frames.values():
        blocked += reference_ranges(o, directions, boxes)[beam] < enter
    return blocked


# Small scenes


def occlusion(out: Path, **parameters: Any) -> moving_occlusion.MovingOcclusion:
    """The effect, prepared from a finished run."""
    tpog = egvs.read_tpog(out / "tpog.parquet")
    made = moving_occlusion.MovingOcclusion(MovingOcclusionParameters.from_dict(parameters))
    return made.prepare(None, tpog, out / "trajectories.parquet")  # type: ignore[arg-type]


class Replayed:
    """A replay with the shares of crossings of any sensor."""

    def __init__(self, boxes: moving_occlusion.Replay) -> None:
        self.boxes = boxes

    def share(self, result: voxel_crossings.Crossings) -> np.ndarray:
        return self.boxes.facing(result.sensor_m, result.grid).share(result)

    def blocked(self, result: voxel_crossings.Crossings) -> np.ndarray:
        return np.rint((1 - self.share(result)) * self.boxes.frames).astype(np.int64)


def replay(frames: dict[int, list[list[float]]], count: int, grid: Grid = GRID) -> Replayed:
    """A replay of ``count`` frames; boxes in the world frame."""
    frame = np.array([f for f, boxes in frames.items() for _ in boxes], dtype=np.int64)
    values = np.array([box for boxes in frames.values() for box in boxes], dtype=np.float64).reshape(-1, 8)
    values[:, :3] -= grid.origin_m
    return Replayed(moving_occlusion.Replay.from_boxes(count, frame, values))


def listed(where: tuple[float, float, float], ends: Any, grid: Grid = GRID) -> voxel_crossings.Crossings:
    """The crossings of fewer beams than one chunk holds."""
    (result,) = voxel_crossings.list_crossings(where, np.asarray(ends, dtype=np.float64), grid)
    return result


def car(
    x: float, y: float, *, yaw: float = 0.0, pitch: float = 0.0, size: tuple[float, float, float] = (4.0, 2.0, 1.5)
) -> list[float]:
    return [x, y, size[2] / 2, yaw, pitch, *size]


def random_scene(seed: int) -> tuple[np.ndarray, voxel_crossings.Crossings, dict[int, np.ndarray]]:
    """A sensor in, above or beside random boxes, and rays of every kind with made-up crossings."""
    draw = np.random.default_rng(seed)
    frames = {}
    for f in np.flatnonzero(draw.random(12) < 0.8):
        n = int(draw.integers(1, 12))
        centre = np.column_stack([draw.uniform(-15, 15, (n, 2)), draw.uniform(-1, 4, n)]) + 40.0
        pitch = draw.choice([0.0, 0.05, -0.3, 1.2], n)
        frames[int(f)] = np.column_stack([centre, draw.uniform(-7, 7, n), pitch, draw.uniform(0.3, 9, (n, 3))])
    o = np.append(draw.uniform(-8, 8, 2), draw.uniform(0, 7)) + 40.0
    ends = draw.normal(size=(300, 3)) * [1, 1, 0.4] * 10
    ends[:40] = np.rint(ends[:40] / 5)  # along axes and diagonals
    ends[40:60] = [0, 0, -8]
    ends[60:62] = [[0, 0, 9], [-7, -0.0, 0]]
    ends[~ends.any(axis=1)] = [1, 0, 0]
    ends *= 30 / np.abs(ends).max(axis=1, keepdims=True)  # beyond all crossings
    counts = draw.integers(0, 9, len(ends))
    first = np.append(0, np.cumsum(counts)).astype(np.int64)
    enter = np.concatenate([np.sort(draw.uniform(0, 25, n)) for n in counts])
    return (
        o,
        voxel_crossings.Crossings(o, WIDE, slice(0, 300), first, ends, np.zeros(len(enter), np.int64), enter, enter),
        frames,
    )


def replay_of(frames: dict[int, np.ndarray], count: int = 12) -> Replayed:
    """A replay from boxes in the grid's frame."""
    frame = np.repeat(list(frames), [len(b) for b in frames.values()]).astype(np.int64)
    return Replayed(moving_occlusion.Replay.from_boxes(count, frame, np.vstack([np.empty((0, 8)), *frames.values()])))


@pytest.fixture
def ran(mini: Path, tmp_path: Path) -> tuple[Path, Path]:
    """A scenario folder and the folder of its finished, plain run."""
    out = tmp_path / "out"
    egvs.run(egvs.load(mini), out)
    return mini, out


def scores(folder: Path, out: Path, *overrides: str, jobs: int | None = None) -> list[float]:
    run_stage(score, egvs.load(folder, overrides), out, jobs=jobs)
    return parquet.read_artefact(out / "scores.parquet", "scores")[0].column("egvs").to_pylist()


def with_trajectories(out: Path, table: pa.Table, groups: int = 1) -> None:
    """Replace the recorded boxes, in ``groups`` row groups."""
    metadata = parquet.read_metadata(out / "trajectories.parquet", "trajectories")
    cuts = np.searchsorted(table.column("frame").to_numpy(), np.linspace(0, metadata["frames"], groups + 1))
    with parquet.artefact_writer(out / "trajectories.parquet", "trajectories") as file:
        for low, high in pairwise(cuts):
            file.write({name: table.column(name).slice(low, high - low).to_pylist() for name in table.column_names})
        file.describe(metadata)


def trajectories(out: Path) -> pa.Table:
    return parquet.read_artefact(out / "trajectories.parquet", "trajectories")[0]


def recorded(out: Path, grid: Grid) -> dict[int, np.ndarray]:
    """Boxes of each frame in the grid's frame."""
    table = trajectories(out)
    names = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "length_m", "width_m", "height_m")
    values = np.column_stack([table.column(name).to_numpy() for name in names])
    values[:, :3] -= grid.origin_m
    frame = table.column("frame").to_numpy()
    return {int(f): values[frame == f] for f in np.unique(frame)}


# By hand


@pytest.mark.slow
def test_car_parked_in_half_of_the_frames_halves_shares_behind_it() -> None:
    half = replay({0: [car(10, 0.25)], 2: [car(10, 0.25)]}, 4)  # from x = 8 to 12
    share = half.share(listed((0, 0.25, 1), [[20, 0, 0]]))
    assert share.tolist() == [1.0] * 17 + [0.5] * 23  # 16 voxels before it, and the first of its own


@pytest.mark.slow
def test_nearest_of_two_cars_counts_once() -> None:
    both = replay({0: [car(15, 0.25), car(5, 0.25)], 1: [car(15, 0.25)]}, 2)
    share = both.share(listed((0, 0.25, 1), [[20, 0, 0]]))
    assert share.tolist() == [1.0] * 7 + [0.5] * 20 + [0.0] * 13


def test_beam_passes_over_under_and_beside_a_vehicle() -> None:
    one = replay({0: [car(10, 0)]}, 1)
    for ends, z in (([20, 0, 0], 1.75), ([20, 0, 0], 1.5), ([20, 1.25, 0], 1.75)):
        assert (one.share(listed((0, 0.25, z), [ends])) == 1).all()
    assert (one.share(listed((0, 1.0, 1), [[20, 0, 0]])) == 1).all()  # along its side, to the last bit
    assert (one.share(listed((0, 1.0 - 0.5e-4, 1), [[20, 0, 0]])) == 1).all()  # 0.05 mm deep
    assert (one.share(listed((0, 1.0 - 2e-4, 1), [[20, 0, 0]])) == 1).sum() == 17  # 0.2 mm deep


def test_box_face_on_a_voxel_face_occludes_from_the_second_voxel_on() -> None:
    one = replay({0: [car(10, 0.25)]}, 1)
    there = one.share(listed((0, 0.25, 1), [[20, 0, 0]]))
    back = one.share(listed((20, 0.25, 1), [[-20, 0, 0]]))
    assert there.tolist() == back.tolist() == [1.0] * 17 + [0.0] * 23


def test_voxel_at_the_end_of_a_beam_counts() -> None:
    stop = -(2 - SHRINK) + 10  # as the slab gives it
    enter = np.array([stop, np.nextafter(stop, 20)])
    ends, none = np.array([[20.0, 0, 0]]), np.zeros(2, np.int64)
    beam = voxel_crossings.Crossings(
        np.array([0.0, 5.25, 1.0]), GRID, slice(0, 1), np.array([0, 2]), ends, none, enter, enter
    )
    assert replay({0: [car(10, 0.25)]}, 1).share(beam).tolist() == [1.0, 0.0]


def test_beams_pass_under_a_pitched_box() -> None:
    level, raised = car(10, 0.25, size=(4, 2, 0.5)), car(10, 0.25, size=(4, 2, 0.5), pitch=0.3)
    level[2] = raised[2] = 1.0
    beams = listed((20, 0.25, 0.8), [[-20, 0, 0]])  # from the front: its nose is 0.59 m up
    assert np.argmin(replay({0: [level]}, 1).share(beams)) == 17
    # Lower front edge of the raised box: x = 10 + 2 cos - 0.25 (-sin) ..., z = 1 + 2 sin - 0.25 cos = 1.35; its belly
    # falls to z = 0.8 where 1 + s sin 0.3 - 0.25 cos 0.3 = 0.8, s = 0.1314, x = 10 + s cos 0.3 + 0.25 sin 0.3 =
    # 10.1994: voxel 20.
    assert np.argmin(replay({0: [raised]}, 1).share(beams)) == 20


def test_vehicle_around_the_sensor_is_ignored_and_counted() -> None:
    beams = listed((10, 0.25, 1), [[9, 0, 0], [0, 0, -0.9], [-9, 1, 0.1]])
    inside = replay({0: [car(10, 0.25)], 1: [car(10, 0.25), car(15, 0.25)]}, 2)
    where = np.array([10, 0.25, 1]) - GRID.origin_m
    assert inside.boxes.count_boxes_around(where) == 2
    assert inside.boxes.count_boxes_around(where + np.array([0, 0, 0.5])) == 0  # on the roof
    share = inside.share(beams)
    assert share[: beams.first[1]].tolist() == [1.0] * 7 + [0.5] * 11
    assert (share[beams.first[1] :] == 1).all()


# Comparison with the reference


@pytest.mark.parametrize("seed", range(40))
def test_random_boxes_and_rays_agree_with_reference(seed: int) -> None:
    o, rays, frames = random_scene(seed)
    expected = reference_blocked(o, rays.ends_m, rays.first, rays.enter_m, frames)
    result = replay_of(frames).blocked(rays)
    assert result.tolist() == expected.tolist()
    assert expected.any()


def fan(tilt: float, step: float, draw: np.random.Generator) -> np.ndarray:
    """Beams of a sensor with 12 channels a column, straight down and along axes among them, tilted about an oblique
    axis; 30 m or longer, in any order."""
    azimuth = np.append(np.arange(24) * step, [0.0, 90, 180, 270])[:, None]
    elevation = np.array([-90.0, -80, -50, -30, -20, -12, -8, -5, -2, 0, 3, 20])
    level, up = np.broadcast_arrays(cosdg(elevation), sindg(elevation) + 0 * azimuth)
    beams = np.stack([level * cosdg(azimuth), level * sindg(azimuth), up], axis=-1).reshape(-1, 3)
    turn = Rotation.from_rotvec(tilt * np.array([0.6, 0.8, 0.0]), degrees=True)
    return draw.permutation(turn.apply(beams) if tilt else beams) * 30


@pytest.mark.parametrize("step", [15.0, 0.02])
@pytest.mark.parametrize("tilt", [0.0, 1e-11, 7.0])
@pytest.mark.parametrize("seed", range(4))
def test_columns_of_channels_agree_with_reference(seed: int, tilt: float, step: float) -> None:
    draw = np.random.default_rng(seed)
    o, _, frames = random_scene(seed)
    standing = [
        np.column_stack([o[0], o[1] + 0.3, o[2] - 2, 0.2, 0.0, 3, 2, 1.5]),
        *frames.values(),
    ]  # the sensor above
    frames = {f: np.vstack([*standing[: f + 1], standing[-1]]) for f in range(len(standing))}  # each in many frames
    ends = fan(tilt, step, draw)
    first = 8 * np.arange(len(ends) + 1)
    enter = np.sort(draw.uniform(0, 25, (len(ends), 8)), axis=1).ravel()
    none = np.zeros(len(enter), dtype=np.int64)
    rays = voxel_crossings.Crossings(o, WIDE, slice(0, len(ends)), first, ends, none, enter, enter)
    expected = reference_blocked(o, ends, first, enter, frames)
    assert replay_of(frames, 40).blocked(rays).tolist() == expected.tolist()
    assert len(set(expected.tolist())) > 3


@pytest.mark.slow
def test_hits_of_weighted_beams_agree_with_listed_crossings(
    ran: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, out = ran
    scene = egvs.build_scene(egvs.load(folder, [ON, ALL]))
    draw = np.random.default_rng(5)
    ends = np.column_stack([draw.uniform(-12, 28, 400), draw.uniform(-22, 20, 400), draw.uniform(-3, 1, 400)])
    ends[:5], weight = [0.0, 0.0, 0.0], draw.uniform(0, 1, 400)
    ends[5:9] = [[0, 0, -3], [9, 0, -2.9], [0, 9, -2.9], [-0.0, -9, -2.9]]
    beams = Beams(Pose(10, -9, 3), scene.sensor("small"), ends, weight)
    visibility = HitCounter(scene, egvs.read_tpog(out / "tpog.parquet"), out / "trajectories.parquet")
    walked = visibility.borrowed_hits(beams).copy()
    monkeypatch.setattr(moving_occlusion, "_BUFFER_SIZE", 1)  # a few beams at a time
    assert walked.tolist() == visibility.borrowed_hits(beams).tolist()
    monkeypatch.setattr(moving_occlusion.MovingOcclusion, "transmittance_steps", lambda *_: None)
    assert walked.tolist() == visibility.borrowed_hits(beams).tolist()
    plain = HitCounter(
        egvs.build_scene(egvs.load(folder, ["effects.dropout.share=1e-9"])),
        egvs.read_tpog(out / "tpog.parquet"),
    )
    assert 0 < walked.sum() < 0.995 * plain.borrowed_hits(beams).sum()


@pytest.mark.slow
def test_hits_of_a_run_agree_with_reference(ran: tuple[Path, Path]) -> None:
    folder, out = ran
    settings = ("roi.voxel_m=1", "sensors.small.azimuth_step_deg=4", 'score.keep_visibility="all"', ON, ALL)
    scenario = egvs.load(folder, settings)
    egvs.run(scenario, out)
    grid = scenario.roi.grid
    frames = recorded(out, grid)
    scans = parquet.read_artefact(out / "scans.parquet", "scans")[0]
    hidden = 0
    for metadata in parquet.read_metadata(out / "scans.parquet", "scans")["sites"]:
        mine = scans.filter(pa.compute.equal(scans.column("site"), metadata["site"]))
        ends = np.column_stack([mine.column(name).to_numpy() for name in ("dx_m", "dy_m", "dz_m")])
        o = np.array([metadata["x_m"], metadata["y_m"], metadata["z_m"]]) - grid.origin_m
        lists = [reference_crossings(o, end, grid) for end in ends]
        first = np.append(0, np.cumsum([len(cells) for cells, _ in lists]))
        blocked = reference_blocked(o, ends, first, np.concatenate([enter for _, enter in lists]), frames)
        complete = np.zeros(np.prod(grid.shape), dtype=np.int64)
        np.add.at(
            complete,
            np.concatenate([cells for cells, _ in lists]),
            np.rint((40 - blocked) / 40 * UNIT).astype(np.int64),
        )
        hits = egvs.read_visibility(out / "visibility.parquet", metadata["site"])
        assert (hits.ravel() * UNIT).tolist() == complete.tolist()
        hidden += int(blocked.sum())
    assert hidden > 1000


@pytest.mark.slow
def test_independent_method_is_a_product_over_voxels(ran: tuple[Path, Path]) -> None:
    folder, out = ran
    scenario = egvs.load(folder, ["roi.voxel_m=1"])
    egvs.run(scenario, out)
    counts, grid = egvs.read_tpog(out / "tpog.parquet").counts.ravel(), scenario.roi.grid
    made = occlusion(out, method="independent")
    draw, where = np.random.default_rng(3), (10.0, 12.0, 3.0)
    ends = np.column_stack([draw.uniform(-12, 28, 60), draw.uniform(-22, -11, 60), np.full(60, -2.9)])
    result = listed(where, ends, grid)
    share, darkest = made.share(result), 1.0
    for n, end in enumerate(ends):
        cells, _ = reference_crossings(np.array([10, 12, 3]) - grid.origin_m, end, grid)
        free = 1.0
        for cell, got in zip(cells, share[result.first[n] : result.first[n + 1]], strict=True):
            assert got == pytest.approx(free, rel=1e-12)
            free *= 1 - counts[cell] / 40
        darkest = min(darkest, free)
    assert darkest < 0.8


# Limits


@pytest.mark.slow
def test_without_vehicles_in_reach_scores_do_not_change(ran: tuple[Path, Path]) -> None:
    folder, out = ran
    plain = parquet.read_artefact(out / "scores.parquet", "scores")[0]
    boxes = trajectories(out)
    assert scores(folder, out, ON) < plain.column("egvs").to_pylist()
    away = boxes.set_column(boxes.column_names.index("y_m"), "y_m", pa.compute.add(boxes.column("y_m"), 500.0))
    for table in (away, boxes.slice(0, 0)):
        with_trajectories(out, table)
        for frames in ("all", "7"):
            assert scores(folder, out, f"effects.moving_occlusion.frames={frames}") == plain.column("egvs").to_pylist()


def test_independent_method_without_occupancy_changes_nothing() -> None:
    free = moving_occlusion.IndependentVoxels(10, np.zeros(np.prod(GRID.shape), dtype=np.uint32))
    assert (free.share(listed((-1, 0.3, 3), [[20, 1, -2], [3, 3, -3]])) == 1).all()


def test_always_occupied_voxel_occludes_everything_behind_it() -> None:
    counts = np.zeros(GRID.shape, dtype=np.uint32)
    counts[16] = 10
    share = moving_occlusion.IndependentVoxels(10, counts.ravel()).share(listed((0, 0.25, 1), [[20, 0, 0]]))
    assert share.tolist() == [1.0] * 17 + [0.0] * 23


def test_boxes_behind_sensor_and_last_crossing_occlude_nothing() -> None:
    none = replay({0: [car(18, 0.25), car(-4, 0.25), car(1, 4)]}, 1)
    assert (none.share(listed((0, 0.25, 1), [[15, 0, 0]])) == 1).all()


# Truths


@pytest.mark.parametrize("seed", range(5))
def test_more_vehicles_never_raise_a_share(seed: int) -> None:
    _, rays, frames = random_scene(seed)
    _, _, others = random_scene(seed + 100)
    more = {
        f: np.vstack([frames.get(f, np.empty((0, 8))), others.get(f, np.empty((0, 8)))])
        for f in sorted({*frames, *others})
    }
    fewer, all_of_them = replay_of(frames).share(rays), replay_of(more).share(rays)
    assert (all_of_them <= fewer).all()
    assert (all_of_them < fewer).any()


def test_share_is_the_mean_over_frames_in_any_order() -> None:
    _, rays, frames = random_scene(7)
    single = [replay_of({0: boxes}, 1).blocked(rays) for boxes in frames.values()]
    assert sum(single).tolist() == replay_of(frames).blocked(rays).tolist()
    turned = {f: boxes[::-1] for f, boxes in zip(frames, reversed(frames.values()), strict=True)}
    assert replay_of(turned).blocked(rays).tolist() == replay_of(frames).blocked(rays).tolist()


@pytest.mark.slow
def test_occlusion_multiplies_with_rain(ran: tuple[Path, Path]) -> None:
    folder, out = ran
    scenario = egvs.load(folder, [ON, ALL, "effects.rain.rate_mm_h=30"])
    pose, ends = Pose(1, -9, 3), np.array([[20.0, 9.0, -2.5]])
    result = listed(pose.position_m, ends, scenario.roi.grid)
    occluded = occlusion(out, frames="all").for_sensor(result.sensor_m, result.grid).share(result)
    centres_m = (np.column_stack(np.unravel_index(result.cells, result.grid.shape)) + 0.5) * result.grid.voxel_m
    range_m = np.sqrt(((centres_m - result.sensor_m) ** 2).sum(axis=1))
    rain = Rain(RainParameters(rate_mm_h=30)).detect(range_m, None)  # type: ignore[arg-type]
    scene = egvs.build_scene(scenario)
    visibility = HitCounter(scene, egvs.read_tpog(out / "tpog.parquet"), out / "trajectories.parquet")
    hits = visibility.borrowed_hits(Beams(pose, scene.sensor("small"), ends))
    assert np.abs(hits[result.cells] - rain * np.rint(occluded * UNIT)).max() <= 1
    assert occluded.min() < 1 > rain.max()


def test_shares_do_not_depend_on_the_position_of_the_scene() -> None:
    far = Grid((GRID.origin_m[0] + 2.0**18, GRID.origin_m[1] - 2.0**21, 0.0), GRID.voxel_m, GRID.shape)
    boxes, ends = {0: [car(8, 0.5, yaw=0.5)], 1: [car(12, -0.25, yaw=-1)]}, [[20, 0, 0], [19, 1, 0.125]]
    moved = {f: [[x + 2.0**18, y - 2.0**21, *rest] for x, y, *rest in cars] for f, cars in boxes.items()}
    here = replay(boxes, 3).share(listed((0, 0.25, 1), ends))
    there = replay(moved, 3, far).share(listed((2.0**18, 0.25 - 2.0**21, 1), ends, far))
    assert here.tolist() == there.tolist()
    assert len(set(here.tolist())) == 3


@pytest.mark.slow
@pytest.mark.parametrize("switch", [ON, INDEPENDENT])
def test_occlusion_does_not_depend_on_threads(ran: tuple[Path, Path], switch: str) -> None:
    folder, out = ran
    digests = set()
    for jobs in (1, 2, 3):
        scores(folder, out, switch, jobs=jobs)
        digests.add(files.hash_file(out / "scores.parquet"))
    assert len(digests) == 1


# Which frames


@pytest.mark.slow
def test_subset_of_frames_is_reproducible(ran: tuple[Path, Path]) -> None:
    folder, out = ran
    few = scores(folder, out, "effects.moving_occlusion.frames=9")
    assert few == scores(folder, out, "effects.moving_occlusion.frames=9")
    complete = scores(folder, out, ON, ALL)
    assert complete != few
    for frames in (0, 40, 41, 500):
        assert scores(folder, out, f"effects.moving_occlusion.frames={frames}") == complete
    assert scores(folder, out, ON) == complete  # the default is more than this scenario records


def test_reads_only_row_groups_with_replayed_frames(ran: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    _, out = ran
    complete = occlusion(out, frames=1).ready
    with_trajectories(out, trajectories(out), groups=40)
    read: list[int] = []
    true = parquet.read_row_group
    monkeypatch.setattr(
        parquet, "read_row_group", lambda file, group, *more: read.append(group) or true(file, group, *more)
    )
    read.clear()
    parts = occlusion(out, frames=1).ready
    assert read[-1] == 20 and read.count(20) == 1
    assert isinstance(complete, moving_occlusion.Replay) and isinstance(parts, moving_occlusion.Replay)
    assert complete.values.tolist() == parts.values.tolist() and len(parts.values) == 2


@pytest.mark.slow
def test_boxes_beyond_sites_and_region_occlude_nothing(ran: tuple[Path, Path]) -> None:
    folder, out = ran
    boxes, before = trajectories(out), scores(folder, out, ON, ALL)
    away = boxes.set_column(boxes.column_names.index("x_m"), "x_m", pa.compute.add(boxes.column("x_m"), 80.0))
    with_trajectories(out, pa.concat_tables([boxes, away.cast(boxes.schema)]).sort_by("frame"))
    assert scores(folder, out, ON, ALL) == before


def test_vehicle_between_site_and_region_occludes(ran: tuple[Path, Path]) -> None:
    folder, out = ran
    plain = scores(folder, out)
    boxes = trajectories(out)
    columns = dict(
        zip(("x_m", "y_m", "z_m", "length_m", "width_m", "height_m"), (10.0, 10.7, 1.5, 1.0, 1.0, 3.0), strict=True)
    )
    for name, value in columns.items():
        boxes = boxes.set_column(boxes.column_names.index(name), name, pa.array([value] * len(boxes)))
    with_trajectories(out, boxes)
    near, other = scores(folder, out, ON)
    assert 0 < near < 0.8 * plain[0]
    assert 0.95 * plain[1] < other <= plain[1]


@pytest.mark.slow
def test_scores_are_the_same_without_stored_scans(ran: tuple[Path, Path]) -> None:
    folder, out = ran
    remaining = scores(folder, out, ON)
    (out / "scans.parquet").unlink()
    assert scores(folder, out, ON, "scan.keep=false") == remaining


# Messages of the stage


def test_scores_depend_on_the_trajectories_only_when_they_are_replayed(ran: tuple[Path, Path]) -> None:
    folder, out = ran
    named = {"trajectories.parquet": files.hash_file(out / "trajectories.parquet")}
    plain = inputs_of(score, egvs.load(folder), out).files
    assert inputs_of(score, egvs.load(folder, [ON]), out).files == plain | named
    assert inputs_of(score, egvs.load(folder, [INDEPENDENT]), out).files == plain
    assert inputs_of(score, egvs.load(folder, ["effects.rain.rate_mm_h=3"]), out).files == plain


def test_frames_all_and_zero_are_the_same_setting(mini: Path, tmp_path: Path) -> None:
    assert MovingOcclusionParameters(frames="all") == MovingOcclusionParameters(frames=0)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["method=sometimes"], "moving_occlusion.method: expected 'frames' or 'independent', got 'sometimes'"),
        (["frames=-1"], "moving_occlusion.frames: expected a value greater than or equal to 0, got -1"),
        (["frames=2.5"], "moving_occlusion.frames: expected a valid integer, got 2.5"),
        (["frames=true"], "moving_occlusion.frames: expected a valid integer, got True"),
        (["frames=most"], "moving_occlusion.frames: expected a valid integer, got 'most'"),
        (["frame=7"], "moving_occlusion.frame: unknown key. Did you mean frames?"),
        (
            ["method=independent", "frames=7"],
            'moving_occlusion.frames: 7: has no effect with method = "independent"',
        ),
    ],
)
def test_rejects_bad_parameters(run_egvs: Any, mini: Path, tmp_path: Path, settings: list[str], message: str) -> None:
    overrides = [word for setting in settings for word in ("--set", f"effects.moving_occlusion.{setting}")]
    code, _, err = run_egvs("run", mini, "--out", tmp_path / "out", *overrides)
    assert code == 2
    assert message in " ".join(err.split())


def test_rejects_bad_trajectories(ran: tuple[Path, Path]) -> None:
    folder, out = ran
    boxes = trajectories(out)
    width = boxes.column_names.index("width_m")
    flat = boxes.set_column(width, "width_m", pa.compute.multiply(boxes.column("width_m"), 0.0))
    with_trajectories(out, flat)
    with pytest.raises(InputError, match="width_m = 0"):
        scores(folder, out, ON)
    with_trajectories(out, boxes.sort_by([("frame", "descending")]))
    with pytest.raises(InputError, match="out of order"):
        scores(folder, out, ON)
    (out / "trajectories.parquet").unlink()
    with pytest.raises(InputError, match="no such file"):
        scores(folder, out, ON)


def test_share_needs_preparation() -> None:
    with pytest.raises(RuntimeError, match="prepare"):
        moving_occlusion.MovingOcclusion(MovingOcclusionParameters()).share(listed((0, 0, 1), [[20, 0, 0]]))


# The comparison


@pytest.mark.slow
def test_reports_the_error_of_the_independent_method(ran: tuple[Path, Path]) -> None:
    folder, out = ran
    plain, framed, independent = scores(folder, out), scores(folder, out, ON), scores(folder, out, INDEPENDENT)
    result = benchmark.compare(egvs.load(folder, [ON]), out)
    rows = result["rows"]
    assert [row["site"] for row in rows] == ["pole_a", "pole_b"]
    assert [row["plain"] for row in rows] == plain
    assert [row["frames"] for row in rows] == framed
    assert [row["independent"] for row in rows] == independent
    assert [row["error"] for row in rows] == [(i - f) / f for i, f in zip(independent, framed, strict=True)]
    assert all(0 < i < f < p for i, f, p in zip(independent, framed, plain, strict=True))
    assert set(result["tau"]) == {"plain, frames", "independent, frames", "independent, plain"}
    assert all(tau in (-1.0, 1.0) for tau in result["tau"].values())
