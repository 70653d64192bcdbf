"""Tables and lines of what validation has to tell: scores, exports, how far it is, what it found."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.cli.terminal import console, table
from pipeline.report.score_words import SCORES
from pipeline.scenario.score import RECOMMENDED
from pipeline.validation.agreement import main_measure
from pipeline.validation.detection import ALL
from pipeline.validation.looking import LookListener
from pipeline.validation.site_findings import POINTS

if TYPE_CHECKING:
    from pipeline.core.cost import Cost
    from pipeline.scenario.models import Scenario
    from pipeline.validation.agreement import ScoreName, Validation
    from pipeline.validation.exports.exporting import Export
    from pipeline.validation.fused.validating import PlanValidation
    from pipeline.validation.metrics.leave_out import Estimate
    from pipeline.validation.statistics.correlation import Correlation
    from pipeline.validation.surrogates.base import Value
    from pipeline.validation.surrogates.registry import Entry

_FILE_WIDTH = 160

FRAME_MS = {"points": 4.0, "cluster": 17.0, "pointpillars": 80.0}
"""A frame of 57,600 beams with each detector, measured on one core of a small cloud machine; of points, its cloud."""

SITE_S = 0.5
"""The empty scan of a site."""


def print_scores(entries: Iterable[Entry]) -> None:
    """Scores: formula in words, which way is better, what is tried, source; of one that cannot be loaded, why."""
    names = ("score", "formula", "better", "tried with", "source")
    rows = table(names, left=names, whole=("score", "better"))
    for entry in entries:
        score = entry.score
        if score is None:
            rows.add_row(entry.name, entry.problem, "broken", "", "")
            continue
        source = score.source + (f" (package {entry.package})" if entry.package else "")
        rows.add_row(score.name, score.formula, "more" if score.sign > 0 else "less", _tried(score.sweep), source)
    out = console(_FILE_WIDTH, soft_wrap=False)
    out.print(rows, markup=False)
    others = ", ".join(name for name in SCORES if name != RECOMMENDED)
    out.print(
        f"sites can be ranked by {RECOMMENDED}, which is recommended, or by {others}: [score] rank_by", markup=False
    )


def print_validation(scenario: Scenario, out: Path, done: Validation) -> None:
    """What each detector finds from each site, and how well scores agree with it."""
    own = done.own_score(scenario)
    egvs = done.values_of(own)
    order = sorted(egvs, key=lambda site: -egvs[site])
    detectors = list(dict.fromkeys(row.detector for row in done.detections))
    named = {(row.site, row.detector): row for row in done.detections if row.objects_of == ALL}
    names = ("site", "EGVS, kbit", *(f"{name}: {_HEADS[main_measure(name)]}" for name in detectors))
    rows = table(names, left=("site",), whole=("site",))
    for site in order:
        its = (named[site, name].measures[main_measure(name)] for name in detectors)
        rows.add_row(site, f"{egvs[site] / 1e3:.1f}", *(f"{100 * m.value:.1f} ± {100 * m.se:.1f}" for m in its))
    console(_FILE_WIDTH, soft_wrap=False).print(rows, markup=False)
    some = next(iter(named.values()))
    print(f"{some.objects} vehicles in {some.frames} frames of traffic that the TPOG never saw; ± is a standard error")
    print()
    _print_agreement(done, own, detectors)
    for doubt in done.doubts:
        print(f"warning: {doubt}")
    print(f"{out}: detection.parquet, surrogates.parquet, correlation.parquet, validation.png")
    if done.report:
        print(done.report)


def _print_agreement(done: Validation, own: ScoreName, detectors: Sequence[str]) -> None:
    """Of each score the choice of parameters that the scenario has; Spearman's rho with what detectors find."""
    shown = [name for name in done.scores if name == own or name.score != own.score]
    heads = ("Spearman's rho with detection", *detectors)
    rows = table(heads, left=heads[:1], whole=heads)
    for name in shown:
        each = (done.agreement(name, detector, main_measure(detector)).by_kind["spearman"] for detector in detectors)
        rows.add_row(str(name), *map(_interval, each))
    console(_FILE_WIDTH, soft_wrap=False).print(rows, markup=False)


def _interval(its: Correlation) -> str:
    if not math.isfinite(its.value):
        return "-"
    between = f" ({its.interval.low:.2f} to {its.interval.high:.2f})" if math.isfinite(its.interval.low) else ""
    return f"{its.value:.2f}{between}"


_BOXED = {
    "AP BEV .7, %": "ap_bev_r40_iou70",
    "3D .7": "ap_3d_r40_iou70",
    "BEV .5": "ap_bev_r40_iou50",
    "3D .5": "ap_3d_r40_iou50",
}
_COUNTED = {"seen with 1 point, %": "seen_1", "5": "seen_5", "20": "seen_20"}


def print_plan_validation(done: PlanValidation) -> None:
    """What each detector finds with 1, 2, ... sensors, and what the last one brings."""
    rows = [row for row in done.rows if row.detection.objects_of == ALL]
    for detector in dict.fromkeys(row.detection.detector for row in rows):
        shown = _COUNTED if detector == POINTS else _BOXED
        what = "seen_20" if detector == POINTS else "BEV + 3D .7"
        names = (detector, "with", *shown, f"gain, {what}")
        lines = table(names, left=names[1:2], whole=names)
        for row in (row for row in rows if row.detection.detector == detector):
            values = (row.detection.measures[name] for name in shown.values())
            also = f"+ {row.sites[-1]}" if len(row.sites) > 1 else row.sites[0]
            gain = _percent(row.gain) if len(row.sites) > 1 else ""
            lines.add_row(str(len(row.sites)), also, *map(_percent, values), gain)
        console(_FILE_WIDTH, soft_wrap=False).print(lines, markup=False)
    some = rows[0].detection
    print(f"{some.objects} vehicles in {some.frames} frames of traffic that the TPOG never saw; ± is a standard error")
    print(f"fused clouds of the plan by {done.plan.score} in {done.plan.path}; gain: more than with one sensor less")
    for doubt in done.doubts:
        print(f"warning: {doubt}")
    print(done.path)


def _percent(its: Estimate) -> str:
    return f"{100 * its.value:.1f} ± {100 * its.se:.1f}"


_HEADS = {"ap_combined_r40_iou70": "AP from above + in space, %", "seen_20": "seen with 20 points, %"}


def print_training(out: Path, about: Mapping[str, Any]) -> None:
    """What a training came to: average precision on held-out frames as it went on."""
    names = ("step", "ap_bev_r40_iou70", "ap_3d_r40_iou70", "ap_bev_r40_iou50", "recall_bev_iou50")
    rows = table(names, left=(), whole=names)
    for entry in about["curve"]:
        rows.add_row(str(entry["step"]), *(f"{entry[name]:.1%}" for name in names[1:]))
    console(_FILE_WIDTH, soft_wrap=False).print(rows, markup=False)
    print(f"{out}: {about['parameters']:,} parameters, trained on {', '.join(about['junctions'])}")


def print_export(done: Export) -> None:
    """What was written of each site, and where it says more."""
    names = ("site", "sensor", "frames", "points", "labelled boxes", "vehicles in region", "of them seen")
    rows = table(names, left=names[:2], whole=("site",))
    for site in done.sites:
        counts = (site.frames, site.points, site.labelled, site.in_roi, site.in_roi_labelled)
        rows.add_row(site.site, site.sensor, *map(str, counts))
    out = console(_FILE_WIDTH)
    out.print(rows, markup=False)
    out.print(f"{done.folder}/README.md says what is in there ({done.kind})")


def _tried(sweep: Mapping[str, tuple[Value, ...]]) -> str:
    return "; ".join(f"{name} {', '.join(_word(value) for value in values)}" for name, values in sweep.items())


def _word(value: Value) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, float) else str(value)


class LookLines(LookListener):
    """Tells in lines.

    Parameters
    ----------
    say
        Prints a line.
    """

    NOUN = "site"

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say

    def clouds(self, place: str) -> int:
        """How many sensors look from a place."""
        del place
        return 1

    def begins(self, missing: Mapping[str, Sequence[str]], frames: int, processes: int) -> None:
        """What is left to do, and about how long that takes."""
        names = list(dict.fromkeys(name for its in missing.values() for name in its))
        left = sum(map(bool, missing.values()))
        if not left:
            self._say(f"all that detectors find from {len(missing)} {self.NOUN}s was kept from before")
            return
        kept = f" ({len(missing) - left} of {len(missing)} were kept from before)" if left < len(missing) else ""
        looks = {name: sum(name in its for its in missing.values()) for name in names}
        looks["points"] = sum(self.clouds(place) for place, its in missing.items() if its)  # which all need
        seconds = SITE_S * looks["points"] + 1e-3 * frames * sum(
            FRAME_MS.get(name, 0.0) * count for name, count in looks.items()
        )
        about = f"about {_duration(seconds / processes)} with a VLP-32C"
        unknown = [name for name in names if name not in FRAME_MS]
        but = f", and what {', '.join(unknown)} takes" if unknown else ""
        cores = f"{processes} process{'es' if processes > 1 else ''}"
        sites = f"{left} {self.NOUN}{'s' if left > 1 else ''}"
        self._say(f"{frames} frames from {sites}{kept}, {', '.join(names)}, {cores}: {about}{but}")

    def looked(self, site: str, detectors: Sequence[str], cost: Cost) -> None:
        """One line a site."""
        self._say(f"{cost.seconds:>8.1f} s   {site}: {', '.join(detectors)}")


class FusedLines(LookLines):
    """Tells in lines how far the looking from groups of sites is."""

    NOUN = "group"

    def clouds(self, place: str) -> int:
        """How many sensors are in a group."""
        return place.count(" + ") + 1


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} min"
