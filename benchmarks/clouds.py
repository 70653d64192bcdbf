"""Cost of a simulated point cloud with traffic: with all vehicles of a frame, and with the nearest ten."""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import numpy as np

import egvs
from egvs.artefacts import traffic_frames
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.simulation import CloudSimulator, sweep_rng

BOUND_S = 0.003
FRAMES = 100
NEAREST = 10


def rows(scenario: Path, run: Path) -> list[tuple[str, str, str, bool]]:
    """Return milliseconds per frame on one core, for the first sites of a scenario and frames of its finished run."""
    scene = egvs.build_scene(egvs.load(scenario))
    simulators = [CloudSimulator.of_site(scene, site) for site in scene.sites[:3]]
    recorded = list(traffic_frames.read_frames(run / "trajectories.parquet", np.arange(FRAMES, dtype=np.int64) * 50))
    measured = []
    for what, count_boxes in (("all its vehicles", len), (f"the nearest {NEAREST}", lambda _: NEAREST)):
        seconds, points_on_vehicles = [], []
        for simulator in simulators:
            near = [_nearest(frame, simulator.view.pose.position_m[:2], count_boxes(frame.boxes)) for frame in recorded]
            simulator.sweep(near[0], sweep_rng(0, "warm", 0))
            for frame in near:
                random = sweep_rng(0, simulator.view.site, frame.number)
                start = time.perf_counter()
                cloud = simulator.sweep(frame, random)
                seconds.append(time.perf_counter() - start)
                points_on_vehicles.append(int((cloud.owner >= 0).sum()))
        ms, points = statistics.median(seconds) * 1e3, statistics.mean(points_on_vehicles)
        vehicles = statistics.mean(count_boxes(frame.boxes) for frame in recorded)
        text = f"{ms:.2f} ms, {vehicles:.0f} vehicles with {points:.0f} points"
        measured.append((f"a cloud of {simulator.view.sensor.beams} beams, {what}", text, "3 ms", ms < 1e3 * BOUND_S))
    return measured


def _nearest(frame: TrafficFrame, to_m: tuple[float, float], count: int) -> TrafficFrame:
    """Return a frame with only the boxes that are nearest to a point."""
    nearest = np.sort(np.argsort(np.hypot(*(frame.boxes[:, :2] - to_m).T))[:count])
    vehicles, kinds = (tuple(values[i] for i in nearest) for values in (frame.vehicles, frame.kinds))
    return TrafficFrame(
        frame.number, vehicles, kinds, frame.boxes[nearest], frame.pitch_rad[nearest], frame.part[nearest]
    )
