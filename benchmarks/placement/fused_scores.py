"""Compare two joint scores of two LiDARs with what detectors find in their fused point clouds.

    python -m benchmarks.placement.fused_scores scenarios/ingolstadt scenarios/hill --out runs/pairs

Both are ``expected_detections``: of independent sensors, and of fused points (:mod:`egvs.scoring.fused_targets`). For
some pairs of sites of each junction, and on request for the single sites, both are computed on the same vehicles in the
same frames of held-out traffic as the detections. Pairs are drawn at random, most of them at different poles.

*Level*: the share of vehicles that is expected, minus the share that is found; a vehicle is found where a detection
overlaps it by more than 0.7, in the mean of the overlaps from above and in 3D, as in the model of detection. Standard
errors are those of the block jackknife over frames. *Rank*: Spearman's rho over pairs with AP (mean of BEV and 3D, R40,
IoU 0.7). Prints Markdown, and writes it and the values of each group of sensors to the output folder. Detections are
cached, so a second call continues.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.across_junctions.detections import hits_of
from egvs.core import files
from egvs.core.grid import FloatArray, IntArray
from egvs.effects.returns import ReturnProbability
from egvs.extensions.validation.detection_metrics import (
    ALL_OBJECTS,
    BLOCKS,
    JackknifeEstimate,
    frame_blocks,
    measure_detection,
)
from egvs.extensions.validation.detector_results import DetectedBoxes, DetectorResult
from egvs.extensions.validation.detector_runs import run_detectors
from egvs.extensions.validation.held_out_traffic import HeldOutTraffic, prepare_held_out_traffic
from egvs.extensions.validation.plan_validation import FusedDetectionTask, SensorGroup, joint_detectors
from egvs.extensions.validation.tables import PlanRunDisplay
from egvs.scenario.loading import load
from egvs.scoring.fused_targets import fuse_targets
from egvs.scoring.target_scores import detection_chances
from egvs.scoring.targets import TargetRecord, VisibleTargets, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.sensors.sites import Site
from egvs.statistics.ranks import StandardisedValues

APART_S = 7.0
"""Between frames, as in the study of validity."""

AP_MEASURES = ("ap_bev_r40_iou70", "ap_3d_r40_iou70")

INDEPENDENT, FUSED, BEST_VIEW, BEST_SINGLE = "independent", "fused", "fused, best view", "best sensor"
"""The two joint scores; the highest probability of the fused points over the views of all sensors with a point on the
vehicle; and the highest probability of the single sensors, as if their points were not fused."""


@dataclass(frozen=True, eq=False)
class GroupResult:
    """What is expected of one or two sensors, and what a detector finds.

    Attributes
    ----------
    sites
        Names of the sites.
    same_pole
        Whether two sensors share a pole.
    expected
        Probability that each vehicle-frame is found, by score, (n,) float64 each.
    found
        Share of the two views in which each vehicle-frame is found, (n,) float64.
    ap
        Average precision.
    """

    sites: tuple[str, ...]
    same_pole: bool
    expected: Mapping[str, FloatArray]
    found: FloatArray
    ap: float


@dataclass(frozen=True, eq=False)
class JunctionResult:
    """Results of one detector at one junction.

    Attributes
    ----------
    junction
        Name of the scenario.
    block
        Block of frames of each vehicle-frame, (n,) int64.
    block_frames
        Number of frames of each block, (blocks,) int64.
    groups
        Single sensors, then pairs.
    """

    junction: str
    block: IntArray
    block_frames: IntArray
    groups: tuple[GroupResult, ...]


def draw_pairs(sites: Sequence[Site], pairs: int, same_pole_pairs: int, seed: int) -> list[SensorGroup]:
    """Return random pairs of sites at different poles, then of sites at the same pole; fewer where there are fewer."""
    all_pairs = [SensorGroup(pair) for pair in itertools.combinations(sites, 2)]
    rng = np.random.default_rng(seed)
    groups: list[SensorGroup] = []
    for wanted, is_same in ((pairs, False), (same_pole_pairs, True)):
        some = [pair for pair in all_pairs if at_same_pole(pair) == is_same]
        drawn = sorted(rng.permutation(len(some))[:wanted].tolist())
        groups += [some[i] for i in drawn]
    return groups


def at_same_pole(group: SensorGroup) -> bool:
    """Whether all sensors of a group share their position seen from above, if there are several."""
    positions = {site.pose.position_m[:2] for site in group.sites}
    return len(positions) < len(group.sites)


def expected_chances(views: Sequence[VisibleTargets], detector: str) -> dict[str, FloatArray]:
    """Return the probability that each vehicle-frame is found with several sensors, by score, (n,) float64 each."""
    single = np.array([detection_chances(view, (detector,)) for view in views])
    fused = fuse_targets(views)
    by_view = []
    for view in views:
        from_there = replace(fused, range_m=view.range_m, depression_deg=view.depression_deg, side=view.side)
        by_view.append(np.where(view.points > 0.0, detection_chances(from_there, (detector,)), 0.0))
    return {
        INDEPENDENT: 1.0 - np.prod(1.0 - single, axis=0),
        FUSED: detection_chances(fused, (detector,)),
        BEST_VIEW: np.max(by_view, axis=0),
        BEST_SINGLE: single.max(axis=0),
    }


def site_views(held_out: HeldOutTraffic, record: TargetRecord, sites: Sequence[Site]) -> dict[str, VisibleTargets]:
    """Return what each site sees of the vehicles, from its empty scan."""
    scanner = Scanner(held_out.scene)
    views = {}
    for site in sites:
        beams = Beams.of(scanner.scan_site(site))
        views[site.name] = visible_targets(record, beams, ReturnProbability.of(held_out.scene, beams.sensor))
    return views


def measure_junction(
    scenario_folder: Path, folder: Path, detectors: Sequence[str], arguments: argparse.Namespace
) -> dict[str, JunctionResult]:
    """Return the results of each detector at a junction."""
    scenario = load(scenario_folder)
    held_out = prepare_held_out_traffic(
        scenario, folder / "held_out", arguments.frames, apart_s=APART_S, jobs=arguments.jobs
    )
    sites = held_out.scene.sites
    pairs = draw_pairs(sites, arguments.pairs, arguments.same_pole_pairs, arguments.seed)
    single = [SensorGroup((site,)) for site in sites] if arguments.single_sites else []
    groups = [*single, *pairs]
    frames = list(held_out.read())
    record = TargetRecord.of(frames, scenario.roi.grid)
    targets = np.split(record.boxes, np.searchsorted(record.frame, np.arange(1, len(frames))))
    views = site_views(held_out, record, sites)

    task = FusedDetectionTask(held_out, joint_detectors(detectors))
    detections = run_detectors(groups, task, jobs=arguments.jobs, listener=PlanRunDisplay(print))
    rows, _ = measure_detection(frames, held_out.scene.roi, detections)
    measures = {(row.site, row.detector): row.measures for row in rows if row.objects_of == ALL_OBJECTS}
    block_of_frame = frame_blocks(len(frames))

    results = {}
    for detector in detectors:
        of_detector = []
        for group in groups:
            boxes = _boxes(detections[group.name][detector])
            of_group = measures[group.name, detector]
            of_detector.append(
                GroupResult(
                    sites=tuple(site.name for site in group.sites),
                    same_pole=at_same_pole(group),
                    expected=expected_chances([views[site.name] for site in group.sites], detector),
                    found=hits_of(targets, boxes),
                    ap=float(np.mean([of_group[name].value for name in AP_MEASURES])),
                )
            )
        results[detector] = JunctionResult(
            scenario.name, block_of_frame[record.frame], np.bincount(block_of_frame), tuple(of_detector)
        )
    return results


def _boxes(result: DetectorResult) -> list[FloatArray]:
    assert isinstance(result, DetectedBoxes)
    return [frame.boxes for frame in result.frames]


def mean_difference(
    first: Sequence[FloatArray], second: Sequence[FloatArray], block: IntArray, block_frames: IntArray
) -> JackknifeEstimate:
    """Return the mean over groups and vehicle-frames of the first minus the second values, with its standard error.

    Parameters
    ----------
    first, second
        Values of each group, (n,) float64 each.
    block, block_frames
        As in :class:`JunctionResult`.
    """
    differences = np.mean([a - b for a, b in zip(first, second, strict=True)], axis=0)
    values = [differences.mean(), *(differences[block != left_out].mean() for left_out in range(BLOCKS))]
    return JackknifeEstimate.from_values(np.array(values), block_frames)


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> float:
    """Return Spearman's rho; NaN for values that are all equal."""
    ranked = [StandardisedValues.from_values(np.array([values]), "spearman") for values in (first, second)]
    return float(ranked[0].correlate(ranked[1])[0])


def lines(results: Sequence[JunctionResult]) -> Iterator[str]:
    """Yield the table of one detector."""
    names = list(results[0].groups[0].expected)
    heads = [*(f"{name}: level" for name in names), *(f"rho: {name}" for name in names)]
    yield f"| junction | sensors | groups | found | AP | {' | '.join(heads)} |"
    yield f"|---|---|{'---:|' * (len(heads) + 3)}"
    for result in results:
        single = [group for group in result.groups if len(group.sites) == 1]
        pairs = [group for group in result.groups if len(group.sites) > 1]
        poles = [group for group in pairs if not group.same_pole]
        same = [group for group in pairs if group.same_pole]
        for name, groups in (("one", single), ("two poles", poles), ("one pole", same), ("all pairs", pairs)):
            if not groups:
                continue
            found = [group.found for group in groups]
            cells = [result.junction, name, str(len(groups)), f"{100 * np.mean(found):.1f}"]
            cells.append(f"{100 * np.mean([group.ap for group in groups]):.1f}")
            ranks = []
            for score in names:
                expected = [group.expected[score] for group in groups]
                cells.append(_points(mean_difference(expected, found, result.block, result.block_frames)))
                rho = rank_correlation([values.mean() for values in expected], [group.ap for group in groups])
                ranks.append(f"{rho:.2f}" if len(groups) > 3 else "")
            yield f"| {' | '.join(cells + ranks)} |"


def _points(estimate: JackknifeEstimate) -> str:
    return f"{100 * estimate.value:+.1f} ± {100 * estimate.se:.1f}"


def group_values(result: JunctionResult) -> list[dict[str, object]]:
    """Return the values of each group of sensors, for a file."""
    return [
        {
            "sites": list(group.sites),
            "same_pole": group.same_pole,
            "found": float(group.found.mean()),
            "ap": group.ap,
            **{score: float(values.mean()) for score, values in group.expected.items()},
        }
        for group in result.groups
    ]


def main() -> None:
    """Compare both scores at all junctions."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenarios", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--pairs", type=int, default=4, help="pairs of sites at different poles")
    parser.add_argument("--same-pole-pairs", type=int, default=2, help="pairs of sites at the same pole")
    parser.add_argument("--single-sites", action="store_true", help="detect from every single site as well")
    parser.add_argument("--seed", type=int, default=1, help="of the choice of pairs")
    parser.add_argument("--detectors", nargs="+", default=["cluster"])
    parser.add_argument("--jobs", type=int)
    arguments = parser.parse_args()

    by_detector: dict[str, list[JunctionResult]] = {name: [] for name in arguments.detectors}
    for scenario_folder in arguments.scenarios:
        folder = arguments.out / scenario_folder.name
        for name, result in measure_junction(scenario_folder, folder, arguments.detectors, arguments).items():
            by_detector[name].append(result)
            files.write_text(folder / f"{name}.json", json.dumps(group_values(result), indent=1) + "\n")
    text_lines = [f"Level in percentage points of vehicles, {arguments.frames} frames of held-out traffic."]
    for name, results in by_detector.items():
        text_lines += ["", f"`{name}`", "", *lines(results)]
    text = "\n".join([*text_lines, ""])
    files.write_text(arguments.out / "fused_scores.md", text)
    print(text)


if __name__ == "__main__":
    main()
