"""Runs side by side: scores, ranks, how well rankings agree, and what differs in settings and files.

Sites are matched by name. Scores in bits compare only where region, voxels and gamma are the same; shares of
``egvs_limit`` compare further, ranks furthest. Rankings are held against each other pair by pair, over the sites that
both runs have: Kendall's tau-b, Spearman's rho, and the regret of trusting the one run's best site in the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.core import files
from egvs.core.errors import InputError
from egvs.studies.score_errors import best_sites, rank_agreement, regret

SCORES = RunFolder.scores.name

_IGNORED_SETTINGS = ("name", "description", "extends")
_POSE_COLUMNS = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg", "sensor")


@dataclass(frozen=True)
class SiteResult:
    """A site's row of a run's ``scores.parquet``; what a run does not know is None."""

    site: str
    pose: tuple[float | str, ...]
    longitude_deg: float | None
    latitude_deg: float | None
    egvs: float
    egvs_se: float | None
    rank: int
    share: float | None
    """Of ``egvs_limit``."""
    other: float | None = None
    """The score that ranks, and its standard error, where it is not the EGVS."""
    other_se: float | None = None

    @property
    def score(self) -> float:
        """The score that ranks."""
        return self.egvs if self.other is None else self.other


@dataclass(frozen=True)
class ComparedRun:
    """A finished run: ``label`` is short, ``settings`` and ``files`` (sha256) are those that its scores depend on."""

    label: str
    folder: Path
    sites: Mapping[str, SiteResult]
    settings: Mapping[str, Any]
    files: Mapping[str, str]
    rank_by: str = "egvs"


@dataclass(frozen=True)
class RankAgreement:
    """How well two runs agree, over the sites that both have; no numbers where they share none.

    ``best_a`` and ``best_b`` are each run's best of the shared sites, ``regret_a`` the share of run b's best score that
    trusting ``best_a`` would lose.
    """

    a: str
    b: str
    shared: int
    tau: float | None = None
    rho: float | None = None
    best_a: tuple[str, ...] = ()
    best_b: tuple[str, ...] = ()
    regret_a: float | None = None


@dataclass(frozen=True)
class Difference:
    """A setting, or a file's content, that is not the same in all runs; None where a run has none."""

    what: str
    values: tuple[Any, ...]


@dataclass(frozen=True)
class Comparison:
    """Runs side by side; ``sites`` in the order of the first run's ranking, then those of the others."""

    runs: tuple[ComparedRun, ...]
    sites: tuple[str, ...]
    agreements: tuple[RankAgreement, ...]
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]


def compare_runs(folders: Sequence[Path]) -> Comparison:
    """Compare two or more finished runs.

    InputError when there are fewer, or a folder holds no finished and unaltered run.
    """
    if len(folders) < 2:
        raise InputError("compare", f"{len(folders)} run", "two or more folders of finished runs")
    runs = tuple(_read_run(folder, _letter(number)) for number, folder in enumerate(folders))
    pairs = list(combinations(runs, 2))
    agreements = tuple(_agreement(a, b) for a, b in pairs)
    notes = [note for pair in pairs for note in _notes(*pair)]
    return Comparison(runs, _sites_in_order(runs), agreements, tuple(_differences(runs)), tuple(notes))


def _letter(number: int) -> str:
    """A, B, ... Z, AA, AB, ... as columns of a table are called."""
    above, last = divmod(number, 26)
    return (_letter(above - 1) if above else "") + chr(ord("A") + last)


def _read_run(folder: Path, label: str) -> ComparedRun:
    record, path = RunRecord.read(folder), folder / SCORES
    done = record.stages.get("score")
    if done is None:
        raise InputError(
            RunFolder(folder).run_record, "the stage score is not done", "a finished run; call egvs run first"
        )
    if files.hash_file(path) != done.artefacts.get(SCORES):
        raise InputError(path, "is not what the run in its folder made", "the run's own file; call egvs run again")
    scores, about = parquet.read_artefact(path, "scores")
    rows, rank_by = scores.to_pylist(), about.get("rank_by", "egvs")
    made = {name for stage in record.stages.values() for name in stage.artefacts}
    read = {
        name: digest
        for key, stage in record.stages.items()
        if key not in ("check", "report")
        for name, digest in stage.files.items()
        if name not in made
    }
    settings = {**dict(_flatten(record.scenario)), "egvs (version)": record.egvs}
    if settings.get("score.gamma") == "auto":  # the number that it stood for
        settings["score.gamma"] = about["gamma"]
    if (version := record.stages["traffic"].summary.get("sumo") if "traffic" in record.stages else None) is not None:
        settings["sumo (version)"] = version
    return ComparedRun(
        label, folder, {row["site"]: _site_result(row, rank_by) for row in rows}, settings, read, rank_by
    )


def _site_result(row: dict[str, Any], rank_by: str) -> SiteResult:
    limit, is_other = row["egvs_limit"], rank_by != "egvs"
    return SiteResult(
        site=row["site"],
        pose=tuple(row[name] for name in _POSE_COLUMNS),
        longitude_deg=row.get("longitude_deg"),
        latitude_deg=row.get("latitude_deg"),
        egvs=row["egvs"],
        egvs_se=row.get("egvs_se"),
        rank=row["rank"],
        share=row["egvs"] / limit if 0 < limit < float("inf") else None,
        other=row[rank_by] if is_other else None,
        other_se=row.get(f"{rank_by}_se") if is_other else None,
    )


def _flatten(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Each setting under its whole key; rows of tables under their names, or their numbers."""
    if isinstance(value, dict) and value:
        for name, inner in value.items():
            if key or name not in _IGNORED_SETTINGS:
                yield from _flatten(inner, f"{key}.{name}" if key else name)
    elif isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
        for number, row in enumerate(value):
            yield from _flatten(row, f"{key}[{row.get('name', number)}]")
    else:
        yield key, value


def _sites_in_order(runs: Sequence[ComparedRun]) -> tuple[str, ...]:
    ranked = (site for run in runs for site in sorted(run.sites, key=lambda name: run.sites[name].rank))
    return tuple(dict.fromkeys(ranked))


def _agreement(a: ComparedRun, b: ComparedRun) -> RankAgreement:
    shared = [site for site in a.sites if site in b.sites]
    if not shared:
        return RankAgreement(a.label, b.label, 0)
    its, others = (np.array([run.sites[site].score for site in shared]) for run in (a, b))
    first_a, first_b = (tuple(shared[i] for i in sorted(best_sites(scores, 1))) for scores in (its, others))
    tau, rho = (rank_agreement(its, others, kind) if len(shared) > 1 else None for kind in ("tau", "rho"))
    return RankAgreement(a.label, b.label, len(shared), tau, rho, first_a, first_b, regret(its, others))


def _differences(runs: Sequence[ComparedRun]) -> Iterator[Difference]:
    whole_rows: dict[str, None] = {}
    for key in dict.fromkeys(key for run in runs for key in run.settings):
        row = key[: key.rindex("]") + 1] if "]" in key else ""
        have = [any(other.startswith(row) for other in run.settings) for run in runs] if row else []
        if row in whole_rows:
            continue
        if not all(have):  # a row of a table that some runs lack: once, not key by key
            whole_rows[row] = None
            yield Difference(row, tuple("there" if has else None for has in have))
            continue
        if any(other.startswith((f"{key}.", f"{key}[")) for run in runs for other in run.settings):
            continue  # an empty table here, which is told by what another run has in it
        values = tuple(run.settings.get(key) for run in runs)
        if any(value != values[0] for value in values):
            yield Difference(key, values)
    for name in dict.fromkeys(name for run in runs for name in run.files):
        digests = tuple(run.files.get(name) for run in runs)
        if len({digest for digest in digests if digest is not None}) > 1:
            yield Difference(f"content of {name}", tuple(digest and digest[:8] for digest in digests))


def _notes(a: ComparedRun, b: ComparedRun) -> Iterator[str]:
    """What a reader has to know before comparing the numbers of two runs."""
    shared = [site for site in a.sites if site in b.sites]
    if not shared:
        yield f"{a.label} and {b.label} share no site: their rankings cannot be held against each other"
        return
    moved = [site for site in shared if a.sites[site].pose != b.sites[site].pose]
    if moved:
        names = ", ".join(moved[:4]) + (f" and {len(moved) - 4} more" if len(moved) > 4 else "")
        count = "1 site has" if len(moved) == 1 else f"{len(moved)} sites have"
        yield f"{count} the same name in {a.label} and {b.label} but another place, angle or sensor: {names}"
    keys = ["roi.center_m", "roi.size_m", "roi.voxel_m", "score.gamma"]
    other = [key for key in keys if a.settings.get(key) != b.settings.get(key)]
    if a.rank_by != b.rank_by:
        yield f"{a.label} ranks by {a.rank_by}, {b.label} by {b.rank_by}: compare ranks alone"
    elif other and a.rank_by == "egvs":
        yield f"{a.label} and {b.label} differ in {' and '.join(other)}: compare ranks and shares, not bits"
