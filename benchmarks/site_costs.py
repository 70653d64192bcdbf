"""Cost per site of scores that predict detection, and of measuring detection. Printed by ``make bench``.

On one core, on the shipped junction: the empty scan, EGVS, the detections expected from the vehicles of 250 frames, and
AP measured with simulated point clouds of 250 frames of held-out traffic. Scores are timed for all sites, AP for the
first two. Traffic is simulated once for all sites, and is listed separately. Times are processor times.
"""

from __future__ import annotations

import dataclasses
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import egvs
from egvs.artefacts.tpog import read_tpog
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core.resource_usage import measure_usage
from egvs.effects.returns import ReturnProbability
from egvs.extensions.validation import detection_metrics
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME
from egvs.extensions.validation.detector_runs import SiteDetectionTask
from egvs.extensions.validation.detectors import base
from egvs.extensions.validation.held_out_traffic import MIN_SPACING_S, HeldOutTraffic, prepare_held_out_traffic
from egvs.runs.run import ensure_stages
from egvs.runs.run_context import open_folder
from egvs.scenario.score_config import DEFAULT_SAMPLED_FRAMES
from egvs.scoring import target_scores
from egvs.scoring.scorer import Scorer
from egvs.scoring.targets import TargetRecord, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.sensors.sites import Site
from egvs.stages import scene_inputs
from egvs.world.mesh import read_ply

SCENARIO = Path(__file__).resolve().parent.parent / "scenarios" / "nishishinjuku"
AP_SITES = 2
"""Number of sites whose AP is measured."""

REPEATS = 5


def rows() -> list[tuple[str, str, str]]:
    """Return name, milliseconds per site, and the ratio to EGVS."""
    with tempfile.TemporaryDirectory() as temporary, _one_core(), _no_store():
        ms, count = _score_costs(Path(temporary) / "run")
        ap_ms, simulated_s = _detection_costs(Path(temporary) / "unseen")
    egvs = ms["EGVS"]
    each = [(name, f"{values:.1f} ms", f"{values / egvs:.2f} x EGVS") for name, values in (ms | ap_ms).items()]
    return [
        *each,
        (f"scores: median of {count} sites; AP: mean of {AP_SITES}, {DEFAULT_SAMPLED_FRAMES} frames", "", ""),
        (
            "held-out traffic, once for all sites, with the static world (for AP only)",
            f"{simulated_s * 1e3:.0f} ms",
            "",
        ),
    ]


@contextmanager
def _one_core() -> Iterator[None]:
    """Run on one core, if the system supports it."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


@contextmanager
def _no_store() -> Iterator[None]:
    """Switch off the cache."""
    before = os.environ.get("EGVS_STORE")
    os.environ["EGVS_STORE"] = ""
    try:
        yield
    finally:
        del os.environ["EGVS_STORE"]
        if before is not None:
            os.environ["EGVS_STORE"] = before


def _score_costs(folder: Path) -> tuple[dict[str, float], int]:
    """Return milliseconds per site of each score (median over the sites), and the number of sites."""
    folder.mkdir()
    work = open_folder(egvs.load(SCENARIO), folder)
    ensure_stages(work, "statics", "traffic", "tpog")  # not part of the measurement
    scene = scene_inputs.resolve_scene(work.scenario, read_ply(work.path("statics.ply"))[0])
    counted = read_tpog(work.path("tpog.parquet"))
    record = TargetRecord.read(work.path("trajectories.parquet"), counted.grid)
    scanner, scorer = Scanner(scene), Scorer(scene, counted)

    def timed(site: Site) -> list[float]:
        scan, scanned_s = _timed(partial(scanner.scan_site, site))
        beams = Beams.of(scan)
        _, scored_s = _timed(partial(scorer.score, scan))
        visible, counted_s = _timed(partial(visible_targets, record, beams, ReturnProbability.of(scene, beams.sensor)))
        _, models_s = _timed(partial(target_scores.expected_detections, visible))
        return [scanned_s, scored_s, counted_s + models_s, counted_s, models_s]

    timed(scene.sites[0])  # compiles
    median = [[statistics.median(values) for values in zip(*(timed(site) for _ in range(REPEATS)), strict=True)]
              for site in scene.sites]  # fmt: skip
    names = ("empty scan", "EGVS", "expected_detections", "  of which visibility", "  of which the models")
    each = zip(names, zip(*median, strict=True), strict=True)
    return {name: statistics.median(values) * 1e3 for name, values in each}, len(scene.sites)


def _detection_costs(folder: Path) -> tuple[dict[str, float], float]:
    """Return milliseconds per site of measuring AP, by detector, and the seconds to simulate traffic."""
    with measure_usage() as cost:  # SUMO's too
        held_out = prepare_held_out_traffic(egvs.load(SCENARIO), folder, DEFAULT_SAMPLED_FRAMES, apart_s=MIN_SPACING_S)
    frames, sites = list(held_out.read()), held_out.scene.sites[:AP_SITES]
    return {
        f"AP by {name}": 1e3 * _ap_s(held_out, frames, sites, name) for name in target_scores.DETECTORS
    }, cost.busy_s


def _ap_s(held_out: HeldOutTraffic, frames: Sequence[TrafficFrame], sites: Sequence[Site], name: str) -> float:
    """Return seconds per site to scan all beams, simulate clouds, run a detector and compute AP."""
    task = SiteDetectionTask(held_out, {name: base.make_detector(name)})

    def measure(site: Site) -> None:
        result = {site.name: task.at(site, [POINT_COUNTS_NAME, name])}
        detection_metrics.measure_detection(frames, held_out.scene.roi, result)

    short = dataclasses.replace(held_out, numbers=held_out.numbers[:5])
    SiteDetectionTask(short, task.detectors).at(
        sites[0], [POINT_COUNTS_NAME, name]
    )  # compiles, and loads what it needs
    return statistics.mean(_timed(partial(measure, site))[1] for site in sites)


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of a call, and its processor seconds."""
    start = time.process_time()
    result = work()
    return result, time.process_time() - start


if __name__ == "__main__":
    for row in rows():
        print("  ".join(f"{cell:<40}" for cell in row))
