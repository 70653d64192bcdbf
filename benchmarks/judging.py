"""What it costs to judge a site: scores that foretell detection, beside measuring it. ``make bench`` prints it.

All on one core and from one run, on the shipped junction: its empty scan, its EGVS, what is expected of detectors by
the vehicles of 250 frames, and AP as it is measured by looking at point clouds of 250 frames of unseen traffic. Scores
are of all sites, AP of the first two, for time. Traffic is simulated once for any number of sites: it has a line of its
own, and is in none of the others. Seconds are the processor's, which others on a machine hardly add to.
"""

from __future__ import annotations

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
from egvs.core.runtime import measure_usage
from egvs.runs.run import ensure_stages
from egvs.scoring import target_scores
from egvs.scoring.scorer import Scorer
from egvs.scoring.targets import REPLAYED_FRAMES, TargetRecord, detection_probability, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.sensors.sites import Site
from egvs.stages import inputs
from egvs.stages.inputs import open_folder
from egvs.validation import detection_metrics
from egvs.validation.detector_runs import SiteDetectionTask
from egvs.validation.detectors import base
from egvs.validation.held_out_traffic import HeldOutTraffic, prepare_held_out_traffic
from egvs.validation.sweeps import POINT_COUNTS_NAME
from egvs.world.mesh import read_ply

SCENARIO = Path(__file__).resolve().parent.parent / "scenarios" / "nishishinjuku"
LOOKED_FROM = 2
"""Sites that detectors look from."""

REPEATS = 5


def rows() -> list[tuple[str, str, str]]:
    """What, milliseconds a site, and how many times an EGVS that is."""
    with tempfile.TemporaryDirectory() as temporary, _one_core(), _no_store():
        ms, count = _scored(Path(temporary) / "run")
        ap_ms, simulated_s = _looked(Path(temporary) / "unseen")
    egvs = ms["EGVS"]
    each = [(name, f"{its:.1f} ms", f"{its / egvs:.2f} x EGVS") for name, its in (ms | ap_ms).items()]
    return [
        *each,
        (f"scores: median of {count} sites; AP: mean of {LOOKED_FROM}, {REPLAYED_FRAMES} frames", "", ""),
        ("traffic, once for all sites (of AP alone, the static world included)", f"{simulated_s * 1e3:.0f} ms", ""),
    ]


@contextmanager
def _one_core() -> Iterator[None]:
    """This process on one core, where the system can do that."""
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
    """Nothing is fetched that is to be measured."""
    before = os.environ.get("EGVS_STORE")
    os.environ["EGVS_STORE"] = ""
    try:
        yield
    finally:
        del os.environ["EGVS_STORE"]
        if before is not None:
            os.environ["EGVS_STORE"] = before


def _scored(folder: Path) -> tuple[dict[str, float], int]:
    """Milliseconds a site of what is worked out from the scenario's own run, in the median of its sites."""
    folder.mkdir()
    work = open_folder(egvs.load(SCENARIO), folder)
    ensure_stages(work, "statics", "traffic", "tpog")  # simulated like any run's, and not counted here
    scene = inputs.resolve_scene(work.scenario, read_ply(work.path("statics.ply"))[0])
    counted = read_tpog(work.path("tpog.parquet"))
    record = TargetRecord.read(work.path("trajectories.parquet"), counted.grid)
    scanner, scorer = Scanner(scene), Scorer(scene, counted)

    def timed(site: Site) -> list[float]:
        scan, scanned = _timed(partial(scanner.scan_site, site))
        beams = Beams.of(scan)
        _, scored = _timed(partial(scorer.score, scan))
        seen, counted_s = _timed(partial(visible_targets, record, beams, detection_probability(scene, beams.sensor)))
        _, foretold = _timed(partial(target_scores.expected_detections, seen))
        return [scanned, scored, counted_s + foretold, counted_s, foretold]

    timed(scene.sites[0])  # compiles
    median = [[statistics.median(its) for its in zip(*(timed(site) for _ in range(REPEATS)), strict=True)]
              for site in scene.sites]  # fmt: skip
    names = ("empty scan", "EGVS", "expected_detections", "  of which seeing", "  of which the models")
    each = zip(names, zip(*median, strict=True), strict=True)
    return {name: statistics.median(its) * 1e3 for name, its in each}, len(scene.sites)


def _looked(folder: Path) -> tuple[dict[str, float], float]:
    """Milliseconds a site of measuring AP, by detector; and seconds until there is traffic for it."""
    with measure_usage() as cost:  # SUMO's too
        unseen = prepare_held_out_traffic(egvs.load(SCENARIO), folder, REPLAYED_FRAMES)
    frames, sites = list(unseen.read()), unseen.scene.sites[:LOOKED_FROM]
    return {f"AP by {name}": 1e3 * _ap_s(unseen, frames, sites, name) for name in target_scores.DETECTORS}, cost.busy_s


def _ap_s(unseen: HeldOutTraffic, frames: Sequence[TrafficFrame], sites: Sequence[Site], name: str) -> float:
    """Seconds a site to scan all beams, make the clouds, look and work out AP."""
    look = SiteDetectionTask(unseen, {name: base.make_detector(name)})

    def measure(site: Site) -> None:
        found = {site.name: look.at(site, [POINT_COUNTS_NAME, name])}
        detection_metrics.measure_detection(frames, unseen.scene.roi, found)

    short = HeldOutTraffic(unseen.scenario, unseen.scene, unseen.trajectories, unseen.numbers[:5], unseen.keys)
    SiteDetectionTask(short, look.detectors).at(
        sites[0], [POINT_COUNTS_NAME, name]
    )  # compiles, and loads what it needs
    return statistics.mean(_timed(partial(measure, site))[1] for site in sites)


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """What comes out, and seconds of the processor."""
    start = time.process_time()
    found = work()
    return found, time.process_time() - start


if __name__ == "__main__":
    for row in rows():
        print("  ".join(f"{cell:<40}" for cell in row))
