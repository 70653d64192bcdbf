"""What came of a command: the ranking, files and costs of a run; what verify found; what a new scenario holds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from pipeline.artefacts.readers import read_scores
from pipeline.artefacts.run_record import RunRecord
from pipeline.cli.ranking_table import ranking_table
from pipeline.cli.terminal import console, in_words, value_in_words
from pipeline.report.ranking import ScoredSite

if TYPE_CHECKING:
    from pipeline.importers.openstreetmap import NewScenario

_FILE_WIDTH = 150


def print_run(folder: Path, record: RunRecord, *, anything_ran: bool) -> None:
    """The ranking, the artefacts, and what each stage cost."""
    out = console(_FILE_WIDTH)
    _print_scores(out, folder, record)
    table = Table("stage", "artefact", "seconds", "peak MB", box=None, pad_edge=False)
    for stage, done in record.stages.items():
        names = "\n".join(str(folder / name) for name in done.artefacts)
        table.add_row(stage, names, f"{done.cost.seconds:.2f}", f"{done.cost.peak_mb:.0f}")
    out.print(table)
    if not anything_ran:
        out.print("nothing to do: no stage's inputs changed since the last run")


def print_stage(folder: Path, stage: str, record: RunRecord) -> None:
    """What one stage wrote."""
    out = console(_FILE_WIDTH)
    if stage == "score":
        _print_scores(out, folder, record)
    done = record.stages[stage]
    for name in (*done.artefacts, *done.summary.get("clouds", ())):
        out.print(str(folder / name), markup=False)


def print_verification(folder: Path, differences: list[str]) -> None:
    """What verify found."""
    well = ["every artefact is as the run made it, and a second run makes the same bytes"]
    for line in differences or well:
        console(_FILE_WIDTH).print(f"{folder}: {line}", markup=False)


def print_new_scenario(made: NewScenario) -> None:
    """What ``egvs new`` made."""
    out = Console(highlight=False, soft_wrap=True)
    for key, value in made.to_json().items():
        out.print(f"{key}: {in_words(value) if isinstance(value, dict) else value_in_words(value)}", markup=False)
    out.print(f"next: egvs run {made.folder}", markup=False)


def _print_scores(out: Console, folder: Path, record: RunRecord) -> None:
    """The ranking, and the audit's worst case where there was one."""
    out.print(ranking_table(ScoredSite.all_of(read_scores(folder / "scores.parquet")), out.width))
    audit = record.stages["score"].summary.get("audit")
    if audit:
        out.print(
            f"audit: chords add up to {audit['worst_sum']:.1e} of a beam's length at worst, longest piece in no voxel "
            f"{audit['longest_gap_m'] * 1e6:.2f} micrometres, misplaced chords {audit['misplaced_chords']}, "
            f"voxels visited twice {audit['voxels_visited_twice']}"
        )
