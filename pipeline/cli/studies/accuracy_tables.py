"""Tables of an accuracy study: what each setting costs and how far it is off, and which one is recommended."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from pipeline.cli.terminal import WIDE, console, table

if TYPE_CHECKING:
    from pipeline.studies.accuracy import AccuracyStudy
    from pipeline.studies.comparison import Row
    from pipeline.studies.seeds import Seeds

_ENDLESS = 1e8
"""Nobody simulates so many frames."""


def print_study(study: AccuracyStudy, command: str) -> None:
    """What the study found: two tables, what was left out, the recommendation (``command`` and what it takes)."""
    out = console(WIDE)
    is_wide = out.width >= WIDE - 10
    same = [row for row in study.rows if row.kind != "measures"]
    other = [row for row in study.rows if row.kind == "measures"]
    out.print(_settings("settings that approximate the same number, against the reference", same, True, is_wide))
    out.print(f"reference: {_reference(study)}. * on the front of time and error, = recommended")
    out.print(f"seconds are medians; {study.repeated} times a stage was run again for them\n")
    if other:
        title = "settings that measure something else, against the scenario on the same traffic"
        out.print(_settings(title, other, False, is_wide))
    if not is_wide:
        out.print("stages, memory and disk: in a wider window, or in accuracy.parquet")
    for why in dict.fromkeys(study.skipped.values()):
        names = [name for name, its in study.skipped.items() if its == why]
        out.print(f"skipped, {why}: {'; '.join(names)}")
    if study.seeds is not None:
        _print_seeds(out, study.seeds)
    for better, worse, chance, frames in study.neighbours[:3]:
        known = f"about {frames:,.0f} frames tell them apart"
        enough = known if frames < _ENDLESS else "no traffic that one could simulate would tell them apart"
        out.print(f"{better} above {worse}: chance {chance:.0%}; {enough}")
    out.print(_recommendation(study, command))
    for path in study.files:
        out.print(str(path))


def _reference(study: AccuracyStudy) -> str:
    """What the settings are compared with."""
    for row in study.rows:
        if row.kind == "reference":
            known = f"itself known to {row.error_se:.2%} (its largest standard error)"
            return f"traffic {study.times} times as long, {known}"
    return "the scenario itself: nothing longer is to be had, or not within the budget"


def _settings(title: str, rows: Sequence[Row], errors: bool, is_wide: bool) -> Table:
    names = ["", "setting", "seconds"]
    names += ["+-", "busy", "traffic", "tpog", "scan", "score", "memory MB", "disk MB"] if is_wide else []
    names += ["error", "std error"] if errors else []
    names += ["vs own"] if errors and is_wide else []
    names += ["tau", "rho", "kept", "regret"] if is_wide else ["tau", "kept", "regret"]
    settings = table(names, left=("", "setting"), whole=[name for name in names if is_wide or name != "setting"])
    settings.title, settings.title_justify = title, "left"
    for r in rows:
        known = "-" if math.isnan(r.error_se) else f"{r.error_se:.2%}"
        cells = {
            "": "*" * r.front + "=" * r.recommended, "setting": r.setting, "seconds": f"{r.seconds:.2f}",
            "+-": f"{r.seconds_spread:.2f}", "busy": f"{r.busy_s:.2f}", "traffic": f"{r.traffic_s:.2f}",
            "tpog": f"{r.tpog_s:.2f}", "scan": f"{r.scan_s:.2f}", "score": f"{r.score_s:.2f}",
            "memory MB": f"{r.peak_mb:.0f}", "disk MB": f"{r.bytes / 1e6:.1f}", "error": f"{r.error:.2%}",
            "std error": known, "vs own": f"{r.own_change:.2%}", "tau": f"{r.tau:.3f}", "rho": f"{r.rho:.3f}",
            "kept": ", ".join(["best"] * r.best_kept + ["three"] * r.best_three_kept) or "-",
            "regret": f"{r.regret:.2%}",
        }  # fmt: skip
        settings.add_row(*(cells[name] for name in names))
    return settings


def _print_seeds(out: Console, seeds: Seeds) -> None:
    """How far scores of independent runs scatter, and what the standard errors said."""
    scatter = table(("site", "between runs", "standard error", "bias", "expected bias"), left=("site",), fold=False)
    scatter.title, scatter.title_justify = f"{seeds.seeds} independent runs of {seeds.frames} frames, bit", "left"
    for row in zip(seeds.sites, seeds.between, seeds.within, seeds.bias, seeds.expected_bias, strict=True):
        scatter.add_row(row[0], *(f"{value:.0f}" for value in row[1:]))
    out.print(scatter)
    out.print(f"90 % intervals hold the score of all runs together in {seeds.covered:.1%} of cases")


def _recommendation(study: AccuracyStudy, command: str) -> str:
    from pipeline.studies.comparison import WORTH

    if study.empty:
        nothing = "every score is 0, so that there is nothing to choose by"
        return f"{nothing}: look where the region of interest and the traffic are"
    rivals = [row for row in study.rows if row.kind in ("approximates", "scenario")]
    if study.best is None and len(rivals) == 1:
        own = f"{rivals[0].judged:.2%}"
        return f"the budget left no time for any other setting than the scenario's own, with {own}; give it more"
    if study.best is None:
        least = min(rivals, key=lambda row: row.judged)
        return f"no setting is within {study.tolerance:.2%}; the nearest is {least.setting!r}, with {least.judged:.2%}"
    best = study.best
    known = "unknown" if math.isnan(best.error_se) else f"{best.error_se:.2%}"
    cheaper = any(row.judged <= study.tolerance and row.seconds < best.seconds for row in rivals)
    others = f" (what is cheaper saves less than {WORTH:.0%})" if cheaper else ""
    return (
        f"recommended within {study.tolerance:.2%}: {best.setting}, {best.seconds:.2f} s{others}, "
        f"error {best.error:.2%}, standard error {known}\n  {command} {best.overrides}".rstrip()
    )
