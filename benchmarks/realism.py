"""What measured losses and noise do to detection and to the ranks of sites.

``python -m benchmarks.realism [SCENARIO...]``: for each scenario (by default the training junctions roundabout and
hill), the detector ``cluster`` runs at all sites on the same 200 frames of held-out traffic, without further effects
and with each of ``surface_losses``, ``range_noise`` and ``dropout``, and with all three. Their values are the defaults
and, for ``dropout``, the loss on the paint of bright vehicles (``benchmarks.measured_vehicles``).

Prints the mean AP over sites and its change, with standard errors from ten blocks of frames that are paired (the same
frames, and the mean over the same sites), and how the order of sites by AP changes. ``--frames`` and ``--effects``
make it quicker.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import kendalltau, spearmanr

import egvs
from egvs.artefacts.readers import read_scores
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core.grid import FloatArray, Roi
from egvs.core.progress import no_progress
from egvs.extensions.validation.detection_metrics import (
    ALL_OBJECTS,
    JackknifeEstimate,
    estimate_difference,
    frame_blocks,
    measure_detection,
)
from egvs.extensions.validation.detector_results import DetectorResult
from egvs.extensions.validation.detector_runs import SiteDetectionTask, run_detectors
from egvs.extensions.validation.detectors.base import make_detector
from egvs.extensions.validation.held_out_traffic import FrameSampling
from egvs.extensions.validation.validation_run import validation_run
from egvs.runs import run
from egvs.scenario.model import Scenario
from egvs.sensors.sites import Site

SCENARIOS = Path(__file__).parents[1] / "scenarios"
FRAMES, TRAFFIC_FRAMES = 200, 1000
DETECTOR, MEASURE = "cluster", "ap_mean_r40_iou70"
SCORE = "expected_detections"
VARIANTS: dict[str, dict[str, dict[str, float]]] = {
    "none": {},
    "surface_losses": {"surface_losses": {}},
    "range_noise": {"range_noise": {}},
    "dropout 0.05": {"dropout": {"share": 0.05}},
    "all three": {"surface_losses": {}, "range_noise": {}, "dropout": {"share": 0.05}},
}


@dataclass(frozen=True)
class SiteDetections:
    """What the detector finds at each site on the same frames.

    Attributes
    ----------
    sites
        The sites, in the order of the results.
    results
        By site and detector, with the points on vehicles.
    """

    sites: Sequence[Site]
    frames: Sequence[TrafficFrame]
    roi: Roi
    results: Mapping[str, Mapping[str, DetectorResult]]

    @classmethod
    def measure(cls, scenario: Scenario, out: Path, frames: int) -> SiteDetections:
        """Run the detector."""
        with validation_run(scenario, out, FrameSampling(frames), jobs=1, progress=no_progress) as validation:
            scene = validation.record.scene
            task = SiteDetectionTask(validation.record, {DETECTOR: make_detector(DETECTOR)})
            return cls(scene.sites, validation.frames, scene.roi, run_detectors(scene.sites, task, jobs=1))

    def ap_by_site(self) -> dict[str, JackknifeEstimate]:
        """Return the AP of the detector at each site."""
        rows, _ = measure_detection(self.frames, self.roi, self.results)
        return {
            row.site: row.measures[MEASURE]
            for row in rows
            if row.detector == DETECTOR and row.objects_of == ALL_OBJECTS
        }


def mean_over_sites(by_site: dict[str, JackknifeEstimate], frames: int) -> JackknifeEstimate:
    """Return the mean over sites in percent, with its standard error over blocks of frames."""
    values = [100.0 * np.append(estimate.value, estimate.left_out) for estimate in by_site.values()]
    return JackknifeEstimate.from_values(np.mean(values, axis=0), np.bincount(frame_blocks(frames)))


def planned_scores(scenario: Scenario, out: Path) -> FloatArray:
    """Run a scenario, and return :data:`SCORE` of its sites, (n,)."""
    run.run(scenario, out, jobs=1)
    return np.array(read_scores(RunFolder(out).scores).column(SCORE).to_pylist())


HEADING = (
    "| junction | {} | AP, mean of sites | change | change by site | Kendall's tau with none | "
    "largest change of rank | best site | rho of `expected_detections` |\n|---|---|---|---|---|---|---|---|---|"
)


def table_row(
    names: tuple[str, str],
    by_site: dict[str, JackknifeEstimate],
    plain: dict[str, JackknifeEstimate],
    score: FloatArray,
    frames: int,
) -> str:
    """Return a row of the table: AP with an effect, compared with that without, and with the score.

    Parameters
    ----------
    names
        Junction and effect.
    """
    ap, plain_ap = (np.array([100.0 * estimate.value for estimate in each.values()]) for each in (by_site, plain))
    mean = mean_over_sites(by_site, frames)
    change = estimate_difference(mean, mean_over_sites(plain, frames), frames)
    ranks, plain_ranks = (np.argsort(np.argsort(-values)) for values in (ap, plain_ap))
    best = list(by_site)[int(ap.argmax())]
    return (
        f"| {' | '.join(names)} | {mean.value:.1f} ± {mean.se:.1f} | {change.value:+.1f} ± {change.se:.1f} | "
        f"{np.min(ap - plain_ap):+.1f} to {np.max(ap - plain_ap):+.1f} | {kendalltau(ap, plain_ap)[0]:.2f} | "
        f"{np.abs(ranks - plain_ranks).max()} | {best} | {spearmanr(ap, score)[0]:.2f} |"
    )


def compare(scenario: Scenario, out: Path, frames: int, variants: list[str]) -> None:
    """Print a row of the table for each variant."""
    named = {"range_limit": False, **scenario.effects.named}  # losses would act by themselves
    scenario = scenario.with_effects(scenario.effects.model_validate(named))
    score = planned_scores(scenario, out)
    plain = SiteDetections.measure(scenario, out, frames).ap_by_site()
    for name in variants:
        changed = scenario.with_effects(scenario.effects.model_validate({**named, **VARIANTS[name]}))
        by_site = SiteDetections.measure(changed, out, frames).ap_by_site()
        print(table_row((scenario.name, name), by_site, plain, score, frames), flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.realism", description=__doc__.split("\n")[0])
    parser.add_argument("scenarios", type=Path, nargs="*", default=[SCENARIOS / "roundabout", SCENARIOS / "hill"])
    parser.add_argument("--out", type=Path, default=Path("runs") / "realism")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--effects", choices=list(VARIANTS), nargs="+", default=list(VARIANTS))
    given = parser.parse_args()
    print(HEADING.format("effects"))
    for path in given.scenarios:
        scenario = egvs.load(path, [f"traffic.frames={TRAFFIC_FRAMES}"])
        compare(scenario, given.out / scenario.name, given.frames, given.effects)


if __name__ == "__main__":
    main()
