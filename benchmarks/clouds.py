"""What does a point cloud with traffic cost: the paper's sensor, all of a frame's vehicles, or the nearest ten?"""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import numpy as np

import egvs
from egvs.artefacts import traffic_frames
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.validation.cloud_simulation import CloudSimulator, sweep_rng

BOUND_S = 0.003
FRAMES = 100
NEAREST = 10


def rows(scenario: Path, run: Path) -> list[tuple[str, str, str, bool]]:
    """Milliseconds a frame on one core, over the first sites of a scenario and frames of its finished run."""
    scene = egvs.build_scene(egvs.load(scenario))
    makers = [CloudSimulator.of_site(scene, site) for site in scene.sites[:3]]
    recorded = list(traffic_frames.read_frames(run / "trajectories.parquet", np.arange(FRAMES, dtype=np.int64) * 50))
    measured = []
    for what, some in (("all its vehicles", len), (f"the nearest {NEAREST}", lambda _: NEAREST)):
        took, on = [], []
        for maker in makers:
            near = [_nearest(frame, maker.view.pose.position_m[:2], some(frame.boxes)) for frame in recorded]
            maker.sweep(near[0], sweep_rng(0, "warm", 0))
            for frame in near:
                random = sweep_rng(0, maker.view.site, frame.number)
                start = time.perf_counter()
                cloud = maker.sweep(frame, random)
                took.append(time.perf_counter() - start)
                on.append(int((cloud.owner >= 0).sum()))
        ms, points = statistics.median(took) * 1e3, statistics.mean(on)
        vehicles = statistics.mean(some(frame.boxes) for frame in recorded)
        text = f"{ms:.2f} ms, {vehicles:.0f} vehicles with {points:.0f} points"
        measured.append((f"a cloud of {maker.view.sensor.beams} beams, {what}", text, "3 ms", ms < 1e3 * BOUND_S))
    return measured


def _nearest(frame: TrafficFrame, to_m: tuple[float, float], count: int) -> TrafficFrame:
    """A frame with only the boxes that are nearest to a place."""
    kept = np.sort(np.argsort(np.hypot(*(frame.boxes[:, :2] - to_m).T))[:count])
    vehicles, kinds = (tuple(values[i] for i in kept) for values in (frame.vehicles, frame.kinds))
    return TrafficFrame(frame.number, vehicles, kinds, frame.boxes[kept], frame.pitch_rad[kept], frame.part[kept])
