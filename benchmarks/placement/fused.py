"""What a second and a third LiDAR bring in detection, and by which score a plan is best chosen.

    python -m benchmarks.placement.fused scenarios/nishishinjuku --out runs/fused

For each junction, score and number of sensors: the best plan by that score, proved where the search ends in time; what
detectors find in its fused clouds, in frames of traffic that no score has seen. Differences, to the plan of one sensor
less and to the plan of the same size by EGVS, are of the same frames, and so are their standard errors. Prints Markdown
and writes it beside the runs. What was looked at is kept in the store, so a second call goes on.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from egvs.cli.validation_tables import PlanRunDisplay
from egvs.core import files
from egvs.placement import plan
from egvs.scenario.loading import load
from egvs.sensors.sites import candidate_sites
from egvs.validation import detection_metrics
from egvs.validation.detection_metrics import ALL_OBJECTS, JackknifeEstimate, SiteDetection
from egvs.validation.detector_runs import run_detectors
from egvs.validation.held_out_traffic import prepare_held_out_traffic
from egvs.validation.plan_validation import FusedDetectionTask, SensorGroup, estimate_difference, joint_detectors
from egvs.validation.results import main_measure
from egvs.validation.sweeps import POINT_COUNTS_NAME

SCORES = ("egvs", "points_on_target", "expected_detections")
APART_S = 7.0
"""Between frames, as in the study of validity."""

Found = Mapping[tuple[str, str], SiteDetection]
"""By group and detector, over all vehicles."""


@dataclass(frozen=True)
class Chosen:
    """The best plan of so many sensors by one score."""

    score: str
    group: SensorGroup
    share: float
    is_best: bool


def chosen(home: Path, folder: Path, counts: Sequence[int], jobs: int | None) -> Iterator[Chosen]:
    """Every plan of a junction."""
    for score in SCORES:
        for count in counts:
            scenario = load(home, [f"score.rank_by={score!r}", f"placement.count={count}"])
            placed = plan.place(scenario, folder / score, exact=True, jobs=jobs)
            sites = {site.name: site for site in candidate_sites(scenario)}
            group = SensorGroup(tuple(sites[sensor.site] for sensor in placed.sensors))
            yield Chosen(score, group, placed.joint / placed.joint_of_all, placed.solution.is_best)


def look(
    home: Path, folder: Path, plans: Sequence[Chosen], frames: int, detectors: Sequence[str], jobs: int | None
) -> Found:
    """What detectors find in the clouds of each plan."""
    record = prepare_held_out_traffic(load(home), folder / "unseen", frames, apart_s=APART_S, jobs=jobs)
    groups = list({plan.group.name: plan.group for plan in plans}.values())
    fused = FusedDetectionTask(record, joint_detectors(detectors))
    found = run_detectors(groups, fused, jobs=jobs, listener=PlanRunDisplay(print))
    rows, _ = detection_metrics.measure_detection(list(record.read()), record.scene.roi, found)
    return {(row.site, row.detector): row for row in rows if row.objects_of == ALL_OBJECTS}


def lines(plans: Sequence[Chosen], found: Found, detector: str) -> Iterator[str]:
    """A table of one detector."""
    measure, by = main_measure(detector), {(chosen.score, len(chosen.group.sites)): chosen for chosen in plans}
    shown = ("seen_5", "seen_20", "seen_50") if detector == POINT_COUNTS_NAME else _SHOWN
    yield f"| plan by | K | sites | share | {' | '.join(shown)} | {measure}, more than K - 1 | than by egvs |"
    yield f"|---|---:|---|---:|{'---:|' * (len(shown) + 2)}"
    for (score, count), chosen in by.items():
        row = found[chosen.group.name, detector]

        def more(other: Chosen | None, row: SiteDetection = row) -> str:
            if other is None:
                return ""
            less = found[other.group.name, detector]
            return _percent(estimate_difference(row.measures[measure], less.measures[measure], row.frames))

        values = " | ".join(_percent(row.measures[name]) for name in shown)
        names = chosen.group.name + ("" if chosen.is_best else " (not proved)")
        fewer, egvs = by.get((score, count - 1)), None if score == SCORES[0] else by[SCORES[0], count]
        yield f"| `{score}` | {count} | {names} | {chosen.share:.1%} | {values} | {more(fewer)} | {more(egvs)} |"


_SHOWN = ("ap_bev_r40_iou70", "ap_3d_r40_iou70", "ap_bev_r40_iou50", "ap_3d_r40_iou50")


def _percent(its: JackknifeEstimate) -> str:
    return f"{100 * its.value:.1f} ± {100 * its.se:.1f}"


def main() -> None:
    """All junctions that are named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenarios", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--detectors", nargs="+", default=[POINT_COUNTS_NAME, "cluster", "pointpillars"])
    parser.add_argument("--jobs", type=int)
    given = parser.parse_args()
    for home in given.scenarios:
        folder = given.out / home.name
        plans = list(chosen(home, folder, given.counts, given.jobs))
        found = look(home, folder, plans, given.frames, given.detectors, given.jobs)
        some = next(iter(found.values()))
        told = [f"### {home.name}", f"{some.objects} vehicles in {some.frames} frames of unseen traffic, in percent."]
        for detector in dict.fromkeys([POINT_COUNTS_NAME, *given.detectors]):
            told += ["", f"`{detector}`", "", *lines(plans, found, detector)]
        text = "\n".join([*told, ""])
        files.write_text(folder / "fused.md", text)
        print(text)


if __name__ == "__main__":
    main()
