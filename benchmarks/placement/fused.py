"""Detection with a second and a third LiDAR, and the best score to choose a plan by.

    python -m benchmarks.placement.fused scenarios/nishishinjuku --out runs/fused

For each junction, score and number of sensors: the best plan by that score (proved if the search ends in time), and
what detectors find in its fused clouds, in frames of held-out traffic. Differences from the plan with one sensor less,
and from the plan of the same size by EGVS, are of the same frames, as are their standard errors. Prints Markdown, and
writes it to the run folders. Detections are cached, so a second call continues.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from egvs.core import files
from egvs.extensions.validation import detection_metrics
from egvs.extensions.validation.detection_metrics import (
    ALL_OBJECTS,
    JackknifeEstimate,
    SiteDetection,
    estimate_difference,
)
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME
from egvs.extensions.validation.detector_runs import run_detectors
from egvs.extensions.validation.held_out_traffic import prepare_held_out_traffic
from egvs.extensions.validation.plan_validation import FusedDetectionTask, SensorGroup, joint_detectors
from egvs.extensions.validation.results import main_measure
from egvs.extensions.validation.tables import PlanRunDisplay
from egvs.placement import plan
from egvs.scenario.loading import load
from egvs.sensors.sites import candidate_sites

SCORES = ("egvs", "points_on_target", "expected_detections")
APART_S = 7.0
"""Between frames, as in the study of validity."""

DetectionByPlan = Mapping[tuple[str, str], SiteDetection]
"""By group and detector, over all vehicles."""


@dataclass(frozen=True)
class BestPlan:
    """The best plan with some number of sensors by one score."""

    score: str
    group: SensorGroup
    share: float
    is_best: bool


def best_plans(scenario_folder: Path, folder: Path, counts: Sequence[int], jobs: int | None) -> Iterator[BestPlan]:
    """Yield every plan of a junction."""
    for score in SCORES:
        for count in counts:
            scenario = load(scenario_folder, [f"score.rank_by={score!r}", f"placement.count={count}"])
            placed = plan.place(scenario, folder / score, exact=True, jobs=jobs)
            sites = {site.name: site for site in candidate_sites(scenario)}
            group = SensorGroup(tuple(sites[sensor.site] for sensor in placed.sensors))
            yield BestPlan(score, group, placed.joint / placed.joint_of_all, placed.is_best)


def detect(
    scenario_folder: Path,
    folder: Path,
    plans: Sequence[BestPlan],
    frames: int,
    detectors: Sequence[str],
    jobs: int | None,
) -> DetectionByPlan:
    """Return what detectors find in the clouds of each plan."""
    record = prepare_held_out_traffic(load(scenario_folder), folder / "unseen", frames, apart_s=APART_S, jobs=jobs)
    groups = list({plan.group.name: plan.group for plan in plans}.values())
    fused = FusedDetectionTask(record, joint_detectors(detectors))
    detection = run_detectors(groups, fused, jobs=jobs, listener=PlanRunDisplay(print))
    rows, _ = detection_metrics.measure_detection(list(record.read()), record.scene.roi, detection)
    return {(row.site, row.detector): row for row in rows if row.objects_of == ALL_OBJECTS}


def lines(plans: Sequence[BestPlan], detection: DetectionByPlan, detector: str) -> Iterator[str]:
    """Yield the table of one detector."""
    measure, by = (
        main_measure(detector),
        {(best.score, len(best.group.sites)): best for best in plans},
    )
    measures = ("seen_5", "seen_20", "seen_50") if detector == POINT_COUNTS_NAME else _BOX_MEASURES
    yield f"| plan by | K | sites | share | {' | '.join(measures)} | {measure}, more than K - 1 | than by egvs |"
    yield f"|---|---:|---|---:|{'---:|' * (len(measures) + 2)}"
    for (score, count), best in by.items():
        row = detection[best.group.name, detector]

        def gain(other: BestPlan | None, row: SiteDetection = row) -> str:
            if other is None:
                return ""
            less = detection[other.group.name, detector]
            return _percent(estimate_difference(row.measures[measure], less.measures[measure], row.frames))

        values = " | ".join(_percent(row.measures[name]) for name in measures)
        names = best.group.name + ("" if best.is_best else " (not proved)")
        fewer, egvs = by.get((score, count - 1)), None if score == SCORES[0] else by[SCORES[0], count]
        yield f"| `{score}` | {count} | {names} | {best.share:.1%} | {values} | {gain(fewer)} | {gain(egvs)} |"


_BOX_MEASURES = ("ap_bev_r40_iou70", "ap_3d_r40_iou70", "ap_bev_r40_iou50", "ap_3d_r40_iou50")


def _percent(estimate: JackknifeEstimate) -> str:
    return f"{100 * estimate.value:.1f} ± {100 * estimate.se:.1f}"


def main() -> None:
    """Compare the plans of all junctions."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenarios", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--detectors", nargs="+", default=[POINT_COUNTS_NAME, "cluster", "pointpillars"])
    parser.add_argument("--jobs", type=int)
    arguments = parser.parse_args()
    for scenario_folder in arguments.scenarios:
        folder = arguments.out / scenario_folder.name
        plans = list(best_plans(scenario_folder, folder, arguments.counts, arguments.jobs))
        detection = detect(scenario_folder, folder, plans, arguments.frames, arguments.detectors, arguments.jobs)
        first_row = next(iter(detection.values()))
        text_lines = [
            f"### {scenario_folder.name}",
            f"{first_row.objects} vehicles in {first_row.frames} frames of unseen traffic, in percent.",
        ]
        for detector in dict.fromkeys([POINT_COUNTS_NAME, *arguments.detectors]):
            text_lines += ["", f"`{detector}`", "", *lines(plans, detection, detector)]
        text = "\n".join([*text_lines, ""])
        files.write_text(folder / "fused.md", text)
        print(text)


if __name__ == "__main__":
    main()
