"""Do scores predict a detector that measures heights from the sensor, as the one of the source paper may do?

``python -m benchmarks.sensor_heights``: at the 13 sites of nishishinjuku, ``pointpillars_sensor`` (trained with sensors
2 m above the ground, heights relative to the sensor), ``pointpillars_2m`` (the same, heights above the ground) and the
installed detectors run on the same frames of unseen traffic, 7 s apart. Prints Spearman's rho with AP (mean of BEV and
3D, IoU 0.7) of ``expected_detections``, as the mean over models and by that of ``pointpillars_sensor``, and of EGVS
with gamma 10 and 2, and differences of the first two from EGVS, with intervals of 95 % that resample sites and blocks
of frames.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import egvs
from benchmarks.across_junctions import study_detectors
from egvs.artefacts import parquet
from egvs.core.progress import no_progress
from egvs.extensions.validation import surrogates
from egvs.extensions.validation.correlation import Correlation, CorrelationStudy, JunctionScores, MeasureValues
from egvs.extensions.validation.detection_metrics import ALL_OBJECTS, measure_detection
from egvs.extensions.validation.detector_runs import SiteDetectionTask, run_detectors
from egvs.extensions.validation.detectors import base
from egvs.extensions.validation.held_out_traffic import FrameSampling
from egvs.extensions.validation.results import ScoreName
from egvs.extensions.validation.validation_run import validation_run

SCENARIO = Path(__file__).parents[1] / "scenarios" / "nishishinjuku"
FRAMES, APART_S, SEED = 250, 7.0, 3704
MEASURE = "ap_mean_r40_iou70"
MAIN = "expected_detections (detectors cluster+pointpillars)"
FROM_SENSOR = f"expected_detections (detector {study_detectors.SENSOR})"
EGVS = tuple(f"egvs (gamma {gamma}, voxel 0.25)" for gamma in (10, 2))
DETECTORS = (study_detectors.SENSOR, study_detectors.LOW, *base.detector_names())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sensor_heights", description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("runs") / "sensor_heights")
    parser.add_argument("--frames", type=int, default=FRAMES)
    given = parser.parse_args()
    study = CorrelationStudy([measure(given.out, given.frames)], SEED)
    own = (MAIN, FROM_SENSOR)
    pairs = [(score, other) for score in own for other in EGVS]
    heads = ["detector", "mean AP", *own, *EGVS, *(f"{score} minus {other}" for score, other in pairs)]
    print(f"| {' | '.join(heads)} |")
    print("|---|" + "---:|" * (len(heads) - 1))
    for detector, values in study.junctions[0].measures.items():
        cells = [_text(study.correlation(score, detector, "spearman")) for score in (*own, *EGVS)]
        cells += [_text(study.difference(score, other, detector, "spearman")) for score, other in pairs]
        print(f"| `{detector}` | {100.0 * values.values.mean():.1f} | {' | '.join(cells)} |", flush=True)


def measure(out: Path, frames: int) -> JunctionScores:
    """Return the scores of the sites, and the AP of each detector there."""
    scenario = egvs.load(SCENARIO)
    with validation_run(scenario, out, FrameSampling(frames, APART_S), jobs=None, progress=no_progress) as validation:
        scene = validation.record.scene
        task = SiteDetectionTask(validation.record, {name: study_detectors.make(name) for name in DETECTORS})
        rows, _ = measure_detection(validation.frames, scene.roi, run_detectors(scene.sites, task))
        scored = surrogates.compute_surrogates(scenario, validation.folder / "scores", ("expected_detections", "egvs"))
    egvs.run(egvs.load(SCENARIO, [f"score.detector={study_detectors.SENSOR}"]), out / study_detectors.SENSOR)
    by_sensor = parquet.read_artefact(out / study_detectors.SENSOR / "scores.parquet", "scores")[0].to_pylist()
    sites = tuple(site.name for site in scene.sites)
    ap = {(row.detector, row.site): row.measures[MEASURE] for row in rows if row.objects_of == ALL_OBJECTS}
    measures = {name: MeasureValues.from_estimates([ap[name, site] for site in sites]) for name in DETECTORS}
    values = {(str(ScoreName(row.score, row.parameters_json)), row.site): row.sign * row.value for row in scored.rows}
    values |= {(FROM_SENSOR, row["site"]): row["expected_detections"] for row in by_sensor}
    scores = {name: np.array([values[name, site] for site in sites]) for name in (MAIN, FROM_SENSOR, *EGVS)}
    return JunctionScores(scenario.name, sites, scores, measures)


def _text(correlation: Correlation) -> str:
    interval = correlation.interval
    limits = "" if interval.low is None else f" ({interval.low:.2f} to {interval.high:.2f})"
    return f"{correlation.value:.2f}{limits}"


if __name__ == "__main__":
    main()
