"""The runs in a folder: what each is a run of, whether it is complete, and its best site."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RUNS, STAGE_NAMES, RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.core.errors import InputError
from egvs.runs import run_sources
from egvs.scenario.model import Scenario
from egvs.scenario.settings import flatten_settings


@dataclass(frozen=True)
class BestSites:
    """The best sites of a run.

    Attributes
    ----------
    rank_by
        The score that ranks.
    names
        The sites of rank 1.
    score
        Their score.
    of_sites
        Number of all sites.
    """

    rank_by: str
    names: tuple[str, ...]
    score: float
    of_sites: int


@dataclass(frozen=True)
class ListedRun:
    """A run folder.

    Attributes
    ----------
    folder
        Its path.
    last_run_s
        When ``egvs`` was last at work in it, in seconds since 1970.
    size_bytes
        Size of all files in it.
    scenario
        Folder of the scenario.
    overrides
        Settings that differed from the scenario file, by full key.
    missing
        Stages that have not been run with these settings.
    best
        The best sites; None if there are no scores.
    problem
        Why the folder cannot be read; empty if it can.
    """

    folder: Path
    last_run_s: float
    size_bytes: int
    scenario: Path = Path()
    overrides: dict[str, Any] = field(default_factory=dict)
    missing: tuple[str, ...] = ()
    best: BestSites | None = None
    problem: str = ""


def list_runs(folder: Path = RUNS) -> list[ListedRun]:
    """Return the run folders in a folder, the latest one first.

    Only ``run.json`` and ``scores.parquet`` are read. A folder into which a run wrote files, but that has no
    valid record, is listed with its problem; other folders are left out.

    Parameters
    ----------
    folder
        Folder that contains run folders.

    Raises
    ------
    InputError
        When there is no such folder.
    """
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "Give a folder that contains run folders.")
    return [_read_run(run) for run in _run_folders(folder)]


def latest_difference(scenario: Scenario, out: Path) -> tuple[Path, dict[str, tuple[Any, Any]]] | None:
    """Return the latest run of a scenario, and the settings in which it differs from the present ones.

    A complete run with the present settings, if there is one, takes precedence over later ones.

    Parameters
    ----------
    scenario
        The scenario with its overrides.
    out
        Its run folder, which counts besides those in ``runs``.

    Returns
    -------
    tuple, or None
        The run folder, and for each full key the value there and the value here; None if there is no valid run.
    """
    folders = set(_run_folders(RUNS))
    if RunFolder(out).has_record:
        folders.add(out)
    latest = None
    for folder in sorted(folders, key=_last_run_s, reverse=True):
        try:
            record = RunRecord.read(folder)
            source = folder / record.scenario_folder
            if source.resolve() != scenario.folder.resolve():
                continue
            recorded = run_sources.recorded_scenario(folder)
        except InputError:  # no valid record, which "egvs runs" lists
            continue
        changed = run_sources.compared_settings(recorded, scenario)
        if not changed and all(stage in record.stages for stage in STAGE_NAMES):
            return folder, {}
        if latest is None:
            there, here = (flatten_settings(each.model_dump(mode="json")) for each in (recorded, scenario))
            latest = folder, {key: (there.get(key), here.get(key)) for key in changed}
    return latest


def _run_folders(folder: Path) -> list[Path]:
    """Return the folders in a folder in which a run was at work, the latest first."""
    if not folder.is_dir():
        return []
    folders = [path for path in sorted(folder.iterdir()) if path.is_dir() and _was_used(RunFolder(path))]
    return sorted(folders, key=_last_run_s, reverse=True)


def _was_used(folder: RunFolder) -> bool:
    """Whether a run wrote files into a folder; the store, which has a lock too, has a hidden name."""
    if folder.has_record:
        return True
    if not folder.lock.is_file() or folder.path.name.startswith("."):
        return False
    return any(path != folder.lock for path in folder.path.iterdir())


def _last_run_s(folder: Path) -> float:
    run_folder = RunFolder(folder)
    times = [path.stat().st_mtime for path in (run_folder.lock, run_folder.run_record) if path.is_file()]
    return max(times)


def _read_run(folder: Path) -> ListedRun:
    last_run_s, size_bytes = _last_run_s(folder), sum(_file_sizes(folder))
    if not RunFolder(folder).has_record:
        return ListedRun(folder, last_run_s, size_bytes, problem="never finished")
    try:
        record = RunRecord.read(folder)
        best = _read_best(folder) if "score" in record.stages else None
    except InputError as error:
        return ListedRun(folder, last_run_s, size_bytes, problem=f"{Path(error.where).name}: {error.problem}")
    return ListedRun(
        folder=folder,
        last_run_s=last_run_s,
        size_bytes=size_bytes,
        scenario=Path(os.path.normpath(folder / record.scenario_folder)),
        overrides=record.overrides,
        missing=tuple(stage for stage in STAGE_NAMES if stage not in record.stages),
        best=best,
    )


def _read_best(folder: Path) -> BestSites | None:
    """Return the best sites of a run; None if no site is ranked."""
    table, metadata = parquet.read_artefact(RunFolder(folder).scores, "scores")
    rank_by = metadata.get("rank_by", "egvs")
    best = [row for row in table.select(["site", "rank", rank_by]).to_pylist() if row["rank"] == 1]
    if not best:
        return None
    return BestSites(rank_by, tuple(row["site"] for row in best), best[0][rank_by], table.num_rows)


def _file_sizes(folder: Path) -> Iterator[int]:
    for parent, _, names in os.walk(folder):
        for name in names:
            path = Path(parent, name)
            if not path.is_symlink():
                yield path.stat().st_size
