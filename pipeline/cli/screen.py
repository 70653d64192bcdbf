"""How does a run look on a terminal, and in a log?

A progress bar on a terminal, plain lines elsewhere; then tables. Standard output carries results, standard error
progress."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from pipeline.artefacts.readers import SEPARABLE
from pipeline.sensing.sensors import Sensor

if TYPE_CHECKING:
    from pipeline.runs.record import RunRecord, StageRecord
    from pipeline.studies.ablation import Change
    from pipeline.studies.accuracy import AccuracyStudy
    from pipeline.studies.comparison import Row
    from pipeline.studies.effect_overview import Call, Price
    from pipeline.studies.seeds import Seeds


NARROW, WIDE = 110, 190
"""Terminals below ``NARROW`` columns get fewer columns of tables; ``WIDE`` is the width of what goes to a file."""


class Screen:
    """Shows a run as it goes on, and what came of it."""

    def __init__(self, verb: str = "") -> None:
        self._out = Console(width=None if sys.stdout.isatty() else 150, highlight=False, soft_wrap=True)
        self._err = Console(stderr=True, highlight=False, soft_wrap=True)
        self._stage, self._ran = verb, False
        self._bar = Progress(
            TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=self._err, transient=True
        )
        self._task = self._bar.add_task("", total=None, visible=False)
        self._lively = sys.stderr.isatty()

    def __enter__(self) -> Screen:
        if self._lively:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._lively:
            self._bar.stop()

    def progress(self, what: str, done: int, total: int) -> None:
        """A :data:`pipeline.stages.base.Progress`."""
        if self._lively:
            count = f"{done}/{total}" if total else str(done)
            self._bar.update(self._task, description=f"{self._stage}: {what} {count}", completed=done, visible=True)
            self._bar.tasks[0].total = total or None  # update() takes None for "as it was"

    def told(self, stage: str, state: str, record: StageRecord | None) -> None:
        """A :data:`pipeline.runs.workflow.StageListener`."""
        self._stage = stage
        self._ran = self._ran or state != "skipped"
        if record is None:
            if self._lively:
                self._bar.update(self._task, description=stage, completed=0, visible=True)
                self._bar.tasks[0].total = None
            return
        if self._lively:
            self._bar.update(self._task, visible=False)
        took = {"skipped": "unchanged", "fetched": "from store"}.get(state) or f"{record.cost.seconds:.2f} s"
        self._err.print(
            f"{stage:<8} {took:>10}   {_in_words({k: v for k, v in record.summary.items() if k != 'flags'})}",
            markup=False,
        )

    def setting(self, name: str, state: str, said: dict[str, Any]) -> None:
        """A :data:`pipeline.studies.accuracy.Told`. What the budget leaves out is told at the end."""
        if said.get("beyond"):
            return
        took = f"{said['seconds']:.2f} s" if "seconds" in said else state
        self._err.print(
            f"{took:>10}   {name}{' (kept)' if state == 'kept' else ''} {said.get('why', '')}", markup=False
        )

    def result(self, folder: Path, record: RunRecord) -> None:
        """The ranking, the artefacts, and what each stage cost."""
        from pipeline.artefacts.readers import read_scores

        self._out.print(ranking(read_scores(folder / "scores.parquet").to_pylist(), self._out.width))
        self._audit(record)
        table = Table("stage", "artefact", "seconds", "peak MB", box=None, pad_edge=False)
        for stage, done in record.stages.items():
            names = "\n".join(str(folder / name) for name in done.artefacts)
            table.add_row(stage, names, f"{done.cost.seconds:.2f}", f"{done.cost.peak_mb:.0f}")
        self._out.print(table)
        if not self._ran:
            self._out.print("nothing to do: no stage's inputs changed since the last run")

    def stage(self, folder: Path, stage: str, record: RunRecord) -> None:
        """What one stage wrote."""
        if stage == "score":
            from pipeline.artefacts.readers import read_scores

            self._out.print(ranking(read_scores(folder / "scores.parquet").to_pylist(), self._out.width))
            self._audit(record)
        done = record.stages[stage]
        for name in (*done.artefacts, *done.summary.get("clouds", ())):
            self._out.print(str(folder / name), markup=False)

    def verdict(self, folder: Path, wrong: list[str]) -> None:
        """What verify found."""
        if not wrong:
            self._out.print(
                f"{folder}: every artefact is as the run made it, and a second run makes the same bytes", markup=False
            )
        for line in wrong:
            self._out.print(f"{folder}: {line}", markup=False)

    def _audit(self, record: RunRecord) -> None:
        found = record.stages["score"].summary.get("audit")
        if found:
            self._out.print(
                f"audit: chords add up to {found['worst_sum']:.1e} of a beam's length at worst, longest piece in no voxel "
                f"{found['longest_gap_m'] * 1e6:.2f} micrometres, misplaced chords {found['misplaced_chords']}, "
                f"voxels visited twice {found['voxels_visited_twice']}"
            )


def ranking(rows: list[dict[str, Any]], width: int = WIDE) -> Table:
    """Sites by rank, as a table; without poses and sensors where the terminal is narrow."""
    table = Table(box=None, pad_edge=False)
    pose = ["x m", "y m", "z m", "sensor"] if width >= NARROW else []
    unsure = "egvs_se" in rows[0] if rows else False
    doubts = ["std error", "beats next"] if unsure else []
    if unsure and any(row["beats_next"] < SEPARABLE for row in rows):
        table.caption = (
            f"~ not separable from the next site: the chance that it truly scores higher is below {SEPARABLE:.0%}"
        )
    beams = ["beams in ROI"] if width >= NARROW else []
    for name in ("rank", "site", *pose, "EGVS bit", *doubts, "of best", "entropy seen", *beams):
        left = name in ("site", "sensor")
        table.add_column(name, justify="left" if left else "right", no_wrap=name != "site", overflow="fold")
    best = max((row["egvs"] for row in rows), default=0.0)
    ordered = sorted(rows, key=lambda row: row["rank"])
    for row in ordered:
        share = f"{row['egvs'] / best:.1%}" if best > 0 else "-"
        doubt = _doubt(row, row is ordered[-1]) if unsure else ()
        where = (f"{row['x_m']:.2f}", f"{row['y_m']:.2f}", f"{row['z_m']:.2f}", row["sensor"]) if pose else ()
        crossing = (str(row["beams_in_roi"]),) if beams else ()
        table.add_row(
            str(row["rank"]),
            row["site"],
            *where,
            f"{row['egvs']:.1f}",
            *doubt,
            share,
            f"{row['entropy_seen']:.1%}",
            *crossing,
        )
    return table


def _doubt(row: dict[str, Any], last: bool) -> tuple[str, str]:
    """How far a score may be off, and whether the site is told from the next."""
    mark = "~ " if row["beats_next"] < SEPARABLE else ""
    beats = "-" if last else f"{mark}{row['beats_next']:.0%}"
    return f"{row['egvs_se'] / row['egvs']:.1%}" if row["egvs"] > 0 else "-", beats


def catalogue(sensors: Iterable[Sensor]) -> None:
    """The sensors that need no table of the user's."""
    table = Table(box=None, pad_edge=False)
    for name in ("sensor", "channels", "elevation deg", "azimuth step deg", "beams", "range m", "source"):
        table.add_column(name, justify="left" if name in ("sensor", "source") else "right", overflow="fold")
    for s in sensors:
        span = f"{min(s.elevations_deg):g} to {max(s.elevations_deg):g}"
        table.add_row(
            s.name, str(s.channels), span, f"{360 / s.azimuths:.6g}", str(s.beams), f"{s.range_m:g}", s.source
        )
    Console(width=None if sys.stdout.isatty() else 160, highlight=False).print(table)


def effects(calls: Sequence[Call], prices: Mapping[str, Price] | None = None) -> None:
    """Effects, whether they are on, and why; what each costs and changes, where a study says so."""
    console = Console(width=None if sys.stdout.isatty() else 160, highlight=False)
    table, wide = Table(box=None, pad_edge=False), console.width >= NARROW
    costs = ("costs", "changes") if prices is not None else ()
    for name in (
        "effect",
        *(("acts in", "kind") if wide else ()),
        "state",
        "why",
        *costs,
        *(("source",) if wide else ()),
    ):
        table.add_column(name, overflow="fold", no_wrap=name in ("costs", "state"))
    for call in calls:
        price = _price(prices.get(call.name)) if prices is not None else ()
        kind, source = ((call.stage, call.kind), (call.source,)) if wide else ((), ())
        table.add_row(call.name, *kind, call.state, call.why, *price, *source)
    console.print(table)


def _price(price: Price | None) -> tuple[str, str]:
    if price is None:
        return "", ""
    best = "the same best site" if price.regret == 0 else f"another best site, regret {price.regret:.2%}"
    return f"{price.seconds:+.2f} s", f"scores by up to {price.change:.1%}; {best}; tau {price.tau:.2f}"


def ablation(changes: Sequence[Change]) -> None:
    """What each effect changes: scores against the plain scene, and ranks where they differ."""
    plain = changes[0]
    table = Table(
        box=None, pad_edge=False, title="change of each site's score against the plain scene (rank, where it changes)"
    )
    table.add_column("site")
    table.add_column("plain, bit", justify="right")
    for change in changes[1:]:
        table.add_column(change.effect, justify="right")
    parts = [
        [100 * (a / b - 1) if b else float("nan") for a, b in zip(c.scores, plain.scores, strict=True)]
        for c in changes[1:]
    ]
    for row, site in enumerate(plain.sites):
        cells = []
        for change, part in zip(changes[1:], parts, strict=True):
            moved = f" ({plain.ranks[row]} to {change.ranks[row]})" if change.ranks[row] != plain.ranks[row] else ""
            cells.append(f"{part[row]:+.2f} %{moved}")
        table.add_row(site, f"{plain.scores[row]:.1f} ({plain.ranks[row]})", *cells)
    table.add_row("seconds", f"{plain.seconds:.2f}", *(f"{change.seconds:.2f}" for change in changes[1:]))
    Console(width=None if sys.stdout.isatty() else 160, highlight=False).print(table)


def summary(folder: Path, found: dict[str, Any]) -> None:
    """What ``egvs new`` made."""
    console = Console(highlight=False, soft_wrap=True)
    for key, value in found.items():
        console.print(f"{key}: {_in_words(value) if isinstance(value, dict) else _plain(value)}", markup=False)
    console.print(f"next: egvs run {folder}", markup=False)


def accuracy(study: AccuracyStudy, command: str) -> None:
    """What the study found: two tables, what was left out, the recommendation (``command`` and what it takes)."""
    console = Console(width=None if sys.stdout.isatty() else WIDE, highlight=False, soft_wrap=True)
    wide = console.width >= WIDE - 10
    same = [row for row in study.rows if row.kind != "measures"]
    other = [row for row in study.rows if row.kind == "measures"]
    long = "the scenario itself: nothing longer is to be had, or not within the budget"
    for row in same:
        if row.kind == "reference":
            long = (
                f"traffic {study.times} times as long, itself known to {row.error_se:.2%} (its largest standard error)"
            )
    console.print(_settings("settings that approximate the same number, against the reference", same, True, wide))
    console.print(f"reference: {long}. * on the front of time and error, = recommended", markup=False)
    console.print(f"seconds are medians; {study.repeated} times a stage was run again for them\n", markup=False)
    if other:
        title = "settings that measure something else, against the scenario on the same traffic"
        console.print(_settings(title, other, False, wide))
    if not wide:
        console.print("stages, memory and disk: in a wider window, or in accuracy.parquet", markup=False)
    for why in dict.fromkeys(study.skipped.values()):
        names = [name for name, its in study.skipped.items() if its == why]
        console.print(f"skipped, {why}: {'; '.join(names)}", markup=False)
    if study.seeds is not None:
        _seeds(console, study.seeds)
    for better, worse, chance, frames in study.neighbours[:3]:
        enough = (
            f"about {frames:,.0f} frames tell them apart"
            if math.isfinite(frames)
            else "no traffic would tell them apart"
        )
        console.print(f"{better} above {worse}: chance {chance:.0%}; {enough}", markup=False)
    console.print(_recommendation(study, command), markup=False)
    for path in study.files:
        console.print(str(path), markup=False)


def _settings(title: str, rows: Sequence[Row], errors: bool, wide: bool) -> Table:
    table = Table(box=None, pad_edge=False, title=title, title_justify="left")
    names = ["", "setting", "seconds"]
    names += ["+-", "busy", "traffic", "tpog", "scan", "score", "memory MB", "disk MB"] if wide else []
    names += ["error", "std error"] if errors else []
    names += ["vs own"] if errors and wide else []
    names += ["tau", "rho", "kept", "regret"] if wide else ["tau", "kept", "regret"]
    for name in names:
        left = name in ("", "setting")
        table.add_column(name, justify="left" if left else "right", no_wrap=wide or name != "setting", overflow="fold")
    for r in rows:
        known = "-" if math.isnan(r.error_se) else f"{r.error_se:.2%}"
        cells = {
            "": "*" * r.front + "=" * r.recommended, "setting": r.setting, "seconds": f"{r.seconds:.2f}",
            "+-": f"{r.seconds_spread:.2f}", "busy": f"{r.busy_s:.2f}", "traffic": f"{r.traffic_s:.2f}", "tpog": f"{r.tpog_s:.2f}",
            "scan": f"{r.scan_s:.2f}", "score": f"{r.score_s:.2f}", "memory MB": f"{r.peak_mb:.0f}",
            "disk MB": f"{r.bytes / 1e6:.1f}", "error": f"{r.error:.2%}", "std error": known, "vs own": f"{r.own_change:.2%}",
            "tau": f"{r.tau:.3f}", "rho": f"{r.rho:.3f}", "regret": f"{r.regret:.2%}",
            "kept": ", ".join(["best"] * r.best_kept + ["three"] * r.best_three_kept) or "-",
        }  # fmt: skip
        table.add_row(*(cells[name] for name in names))
    return table


def _seeds(console: Console, seeds: Seeds) -> None:
    table = Table(
        box=None,
        pad_edge=False,
        title=f"{seeds.seeds} independent runs of {seeds.frames} frames, bit",
        title_justify="left",
    )
    for name in ("site", "between runs", "standard error", "bias", "expected bias"):
        table.add_column(name, justify="left" if name == "site" else "right")
    for row in zip(seeds.sites, seeds.between, seeds.within, seeds.bias, seeds.expected_bias, strict=True):
        table.add_row(row[0], *(f"{value:.0f}" for value in row[1:]))
    console.print(table)
    console.print(f"90 % intervals hold the score of all runs together in {seeds.covered:.1%} of cases")


def _recommendation(study: AccuracyStudy, command: str) -> str:
    if study.empty:
        return "every score is 0, so that there is nothing to choose by: look where the region of interest and the traffic are"
    rivals = [row for row in study.rows if row.kind in ("approximates", "scenario")]
    if study.best is None and len(rivals) == 1:
        return f"the budget left no time for any other setting than the scenario's own, with {rivals[0].judged:.2%}; give it more"
    if study.best is None:
        least = min(rivals, key=lambda row: row.judged)
        return f"no setting is within {study.tolerance:.2%}; the nearest is {least.setting!r}, with {least.judged:.2%}"
    best = study.best
    known = "unknown" if math.isnan(best.error_se) else f"{best.error_se:.2%}"
    return (
        f"the cheapest setting within {study.tolerance:.2%}: {best.setting}, {best.seconds:.2f} s, error {best.error:.2%}, "
        f"standard error {known}\n  {command} {best.overrides}".rstrip()
    )


def _in_words(said: dict[str, Any]) -> str:
    """A stage's summary in one line: plain values, then tables of counts."""
    return "; ".join(
        f"{key.replace('_', ' ')} {_plain(value)}" for key, value in said.items() if value not in ("", [], {}, None)
    )


def _plain(value: Any) -> str:
    """One value in words; a table of counts as "3 pole, 2 sign"."""
    if isinstance(value, dict):
        parts = ((str(k).replace("_", " "), v) for k, v in value.items())
        return ", ".join(f"{k} ({_plain(v)})" if isinstance(v, dict) else f"{_plain(v)} {k}" for k, v in parts)
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(_plain(v) for v in value)
    return str(value)
