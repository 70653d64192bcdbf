"""Compare finished runs: scores, ranks, agreement of the rankings, and differences of settings and files.

Sites are matched by name. EGVS in bits can be compared if region, voxels and gamma are equal; shares of ``egvs_limit``
and ranks can also be compared otherwise. Rankings are compared in pairs, over the sites that both runs have: Kendall's
tau-b, Spearman's rho, and the regret of using the best site of one run in the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
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
    """A row of ``scores.parquet``; values that a run does not have are None.

    Attributes
    ----------
    site
        Name.
    pose
        x, y, z, yaw, pitch, roll (m and degrees), and name of the sensor.
    longitude_deg, latitude_deg
        Location on the Earth.
    egvs, egvs_se
        EGVS and its standard error, in bits.
    rank
        1 is best.
    share
        EGVS as a share of ``egvs_limit``.
    other, other_se
        The score that ranks and its standard error, if it is not EGVS.
    """

    site: str
    pose: tuple[float | str, ...]
    longitude_deg: float | None
    latitude_deg: float | None
    egvs: float
    egvs_se: float | None
    rank: int
    share: float | None
    other: float | None = None
    other_se: float | None = None

    @property
    def score(self) -> float:
        """The score that ranks."""
        return self.egvs if self.other is None else self.other


@dataclass(frozen=True)
class ComparedRun:
    """A finished run.

    Attributes
    ----------
    label
        A, B, ...
    folder
        The run folder.
    sites
        Results by name.
    settings, files
        Settings by full key, and sha256 of the files that its scores depend on.
    rank_by
        The score that ranks.
    """

    label: str
    folder: Path
    sites: Mapping[str, SiteResult]
    settings: Mapping[str, Any]
    files: Mapping[str, str]
    rank_by: str = "egvs"


@dataclass(frozen=True)
class RankAgreement:
    """Agreement of two rankings, over the sites that both runs have.

    Attributes
    ----------
    a, b
        Labels of the runs.
    shared
        Number of common sites; without any, the other values are empty.
    tau, rho
        Kendall's tau-b and Spearman's rho.
    best_a, best_b
        Best common sites of each run.
    regret_a
        Share of run b's best score that is lost at ``best_a``.
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
    """A setting, or the content of a file, that differs between runs; None for runs without it."""

    what: str
    values: tuple[Any, ...]


@dataclass(frozen=True)
class Comparison:
    """Compared runs; ``sites`` are in the order of the first run's ranking, followed by those of the other runs."""

    runs: tuple[ComparedRun, ...]
    sites: tuple[str, ...]
    agreements: tuple[RankAgreement, ...]
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]


def compare_runs(folders: Sequence[Path]) -> Comparison:
    """Compare finished runs.

    Parameters
    ----------
    folders
        Two or more run folders.

    Raises
    ------
    InputError
        If there are fewer folders, or one contains no finished run, or its scores were altered.
    """
    if len(folders) < 2:
        raise InputError("compare", f"expected at least two runs, got {len(folders)}", "Give folders of finished runs.")
    runs = tuple(_read_run(folder, run_label(number)) for number, folder in enumerate(folders))
    sites: dict[str, None] = {}
    for run in runs:
        ranked = sorted(run.sites.values(), key=lambda site: site.rank)
        sites |= dict.fromkeys(site.site for site in ranked)
    agreements = []
    notes: list[str] = []
    for a, b in combinations(runs, 2):
        agreements.append(compare_rankings(a, b))
        notes += _notes(a, b)
    return Comparison(runs, tuple(sites), tuple(agreements), tuple(find_differences(runs)), tuple(notes))


def run_label(number: int) -> str:
    """Return A, B, ... Z, AA, AB, ... for the numbers from 0, as the columns of a spreadsheet."""
    prefix, last = divmod(number, 26)
    label = chr(ord("A") + last)
    return run_label(prefix - 1) + label if prefix else label


def _read_run(folder: Path, label: str) -> ComparedRun:
    record = RunRecord.read(folder)
    path = folder / SCORES
    score_stage = record.stages.get("score")
    if score_stage is None:
        problem = "expected a finished run, but the stage score was not run"
        raise InputError(RunFolder(folder).run_record, problem, "Run egvs run first.")
    if files.hash_file(path) != score_stage.artefacts.get(SCORES):
        raise InputError(path, "was changed after the run", 'Repeat "egvs run".')
    scores, metadata = parquet.read_artefact(path, "scores")
    rank_by = metadata.get("rank_by", "egvs")

    settings = {**dict(_flatten(record.scenario)), "egvs (version)": record.egvs}
    if settings.get("score.gamma") == "auto":
        settings["score.gamma"] = metadata["gamma"]
    if "traffic" in record.stages and record.stages["traffic"].summary.get("sumo") is not None:
        settings["sumo (version)"] = record.stages["traffic"].summary["sumo"]

    artefacts = {name for stage in record.stages.values() for name in stage.artefacts}
    input_files: dict[str, str] = {}
    for name, stage in record.stages.items():
        if name not in ("check", "report"):
            input_files |= {file: digest for file, digest in stage.files.items() if file not in artefacts}
    sites = {row["site"]: _site_result(row, rank_by) for row in scores.to_pylist()}
    return ComparedRun(label, folder, sites, settings, input_files, rank_by)


def _site_result(row: dict[str, Any], rank_by: str) -> SiteResult:
    limit = row["egvs_limit"]
    result = SiteResult(
        site=row["site"],
        pose=tuple(row[name] for name in _POSE_COLUMNS),
        longitude_deg=row.get("longitude_deg"),
        latitude_deg=row.get("latitude_deg"),
        egvs=row["egvs"],
        egvs_se=row.get("egvs_se"),
        rank=row["rank"],
        share=row["egvs"] / limit if 0 < limit < float("inf") else None,
    )
    if rank_by == "egvs":
        return result
    return replace(result, other=row[rank_by], other_se=row.get(f"{rank_by}_se"))


def _flatten(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each setting with its full key; rows of tables are called by their name or number."""
    if isinstance(value, dict) and value:
        for name, inner in value.items():
            if key:
                yield from _flatten(inner, f"{key}.{name}")
            elif name not in _IGNORED_SETTINGS:
                yield from _flatten(inner, name)
    elif isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
        for number, row in enumerate(value):
            yield from _flatten(row, f"{key}[{row.get('name', number)}]")
    else:
        yield key, value


def compare_rankings(a: ComparedRun, b: ComparedRun) -> RankAgreement:
    """Compare the rankings of two runs.

    Parameters
    ----------
    a, b
        The runs; the regret is that of using the best site of ``a``.
    """
    shared = [site for site in a.sites if site in b.sites]
    if not shared:
        return RankAgreement(a.label, b.label, 0)
    scores_a = np.array([a.sites[site].score for site in shared])
    scores_b = np.array([b.sites[site].score for site in shared])
    tau, rho = None, None
    if len(shared) > 1:
        tau = rank_agreement(scores_a, scores_b, "tau")
        rho = rank_agreement(scores_a, scores_b, "rho")
    best_a = tuple(shared[index] for index in sorted(best_sites(scores_a, 1)))
    best_b = tuple(shared[index] for index in sorted(best_sites(scores_b, 1)))
    return RankAgreement(a.label, b.label, len(shared), tau, rho, best_a, best_b, regret(scores_a, scores_b))


def find_differences(runs: Sequence[ComparedRun]) -> Iterator[Difference]:
    """Yield the settings and files that differ.

    A row of a table that some runs lack is one difference, instead of one for each of its keys.

    Parameters
    ----------
    runs
        The runs.
    """
    missing_rows = set()
    for key in dict.fromkeys(key for run in runs for key in run.settings):
        row = key[: key.rfind("]") + 1]  # "traffic.kinds[car]" of "traffic.kinds[car].length_m"
        if row in missing_rows:
            continue
        have_row = [_has_key_starting(run, row) for run in runs]
        if row and not all(have_row):
            missing_rows.add(row)
            yield Difference(row, tuple("present" if has_row else None for has_row in have_row))
            continue
        if any(_has_key_starting(run, (f"{key}.", f"{key}[")) for run in runs):
            continue  # an empty table here; its rows in other runs are reported
        values = tuple(run.settings.get(key) for run in runs)
        if any(value != values[0] for value in values):
            yield Difference(key, values)
    for name in dict.fromkeys(name for run in runs for name in run.files):
        digests = [run.files.get(name) for run in runs]
        if len(set(digests) - {None}) > 1:
            yield Difference(f"content of {name}", tuple(digest and digest[:8] for digest in digests))


def _has_key_starting(run: ComparedRun, prefix: str | tuple[str, ...]) -> bool:
    return any(key.startswith(prefix) for key in run.settings)


def _notes(a: ComparedRun, b: ComparedRun) -> Iterator[str]:
    """Yield what a reader must know before comparing the numbers of two runs."""
    pair = f"{a.label} and {b.label}"
    shared = [site for site in a.sites if site in b.sites]
    if not shared:
        yield f"{pair} have no site in common, so their rankings cannot be compared"
        return
    moved = [site for site in shared if a.sites[site].pose != b.sites[site].pose]
    if moved:
        names = ", ".join(moved[:4])
        if len(moved) > 4:
            names += f" and {len(moved) - 4} more"
        count = "1 site has" if len(moved) == 1 else f"{len(moved)} sites have"
        yield f"{count} the same name in {pair} but another position, angle or sensor: {names}"
    if a.rank_by != b.rank_by:
        yield f"{a.label} ranks by {a.rank_by}, {b.label} by {b.rank_by}: compare ranks only"
        return
    keys = ("roi.center_m", "roi.size_m", "roi.voxel_m", "score.gamma")
    differing = [key for key in keys if a.settings.get(key) != b.settings.get(key)]
    if differing and a.rank_by == "egvs":
        yield f"{pair} differ in {' and '.join(differing)}: compare ranks and shares, not bits"
