"""Compare finished runs: the best mount of each pole, sensors, ranks, and differences of settings and files.

*By pole*: a pole is a location; candidates with the same x and y share it (:mod:`egvs.sensors.sites`), whatever their
names, heights, angles and sensors. Each run has its best mount there. *By site*: sites are matched by name. Rankings
are compared in pairs, over the poles (by their best mounts) or the sites that both runs have: Kendall's tau-b,
Spearman's rho, and the regret of using the best pole or site of one run in the other.

A single run with several sensors is compared with itself: its sites with each sensor take the place of a run.

EGVS in bits can be compared if region, voxels and gamma are equal; shares of ``egvs_limit`` and ranks can also be
compared otherwise. :mod:`egvs.studies.paired_errors` has the standard errors of differences.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.wording import by_number, list_first, number_of
from egvs.results.labels import join_names
from egvs.results.ranking import Pole, RankedSite, Ranking
from egvs.results.sensors import ScoreDifference, SensorComparison, SensorMount, best_mounts
from egvs.runs.run_sources import PLAN_REQUEST
from egvs.scenario.costs import costs_from_dict
from egvs.scenario.score_config import CostsConfig
from egvs.scenario.settings import flatten_settings, without_replaced
from egvs.sensors.sensor import check_sensor_names
from egvs.statistics.ranks import best_sites, rank_agreement, regret
from egvs.studies.paired_errors import ScoreDifferences, SiteOfRun, interval_changes

SCORES = RunFolder.scores.name

View = Literal["pole", "site"]
"""What the rows of a comparison are."""

_IGNORED_SETTINGS = ("name", "description", "extends")
_EGVS_KEYS = ("roi.center_m", "roi.size_m", "roi.voxel_m", "score.gamma")
"""Settings that must be equal to compare EGVS in bits."""

_RANGE_LIMIT = "effects.range_limit"

_NAMED = 4
"""Number of names in a note."""


class Location(NamedTuple):
    """Where a pole stands, world frame."""

    x_m: float
    y_m: float


@dataclass(frozen=True, repr=False)
class ComparedRun:
    """A finished run, or its sites with one sensor.

    Attributes
    ----------
    label
        A, B, ...
    folder
        The run folder.
    ranking
        Its sites by rank.
    settings, files
        Settings by full key, and sha256 of the files that its scores depend on.
    costs
        Costs of its mounts.
    unrated
        Its sensors without a rated range, whose losses of returns are unknown.
    """

    label: str
    folder: Path
    ranking: Ranking
    settings: Mapping[str, Any]
    files: Mapping[str, str]
    costs: CostsConfig = field(default_factory=CostsConfig)
    unrated: tuple[str, ...] = ()

    def __repr__(self) -> str:
        best = self.ranking.best[0]
        return (
            f"ComparedRun({self.label}: {self.folder}, {len(self.sites)} sites on {len(self.poles)} poles, "
            f"{', '.join(self.sensors)}; best {best.site}, {best.by.with_noun(best.score)})"
        )

    @property
    def has_losses(self) -> bool:
        """Whether losses of returns were simulated, or could not change the result."""
        if self.settings.get(_RANGE_LIMIT) is False:
            return False
        keys = [key for key, value in self.settings.items() if value is not None]
        if any(key == _RANGE_LIMIT or key.startswith(f"{_RANGE_LIMIT}.") for key in keys):
            return True
        return not self.unrated

    @cached_property
    def sites(self) -> Mapping[str, RankedSite]:
        """Sites by name, the best first."""
        return {site.site: site for site in self.ranking.sites}

    @cached_property
    def poles(self) -> Mapping[Location, Pole]:
        """Poles by location, the one with the best site first."""
        return {Location(pole.best.x_m, pole.best.y_m): pole for pole in self.ranking.poles}

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of its sensors, that of the best site first."""
        return tuple(dict.fromkeys(site.sensor for site in self.ranking.sites))

    @property
    def rank_by(self) -> str:
        """The score that ranks."""
        return self.ranking.by.name


@dataclass(frozen=True)
class ComparedPole:
    """A pole, and the best mount of each run there.

    Attributes
    ----------
    name
        Its name in the first run that has it.
    location
        Where it stands.
    mounts
        The best site of each run; None for runs without this pole.
    differences
        For each run, its score minus that of the first run; None for the first run, where one of them lacks the pole,
        and where scores cannot be compared.
    """

    name: str
    location: Location
    mounts: tuple[RankedSite | None, ...]
    differences: tuple[ScoreDifference | None, ...]


@dataclass(frozen=True)
class RankAgreement:
    """Agreement of two rankings, over the poles or sites that both runs have.

    Attributes
    ----------
    a, b
        Labels of the runs.
    shared
        Number of common poles or sites; without any, the other values are empty.
    tau, rho
        Kendall's tau-b and Spearman's rho.
    best_a, best_b
        Names of the best common poles or sites of each run.
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


@dataclass(frozen=True, repr=False)
class Comparison:
    """Compared runs.

    Attributes
    ----------
    runs
        The runs, or the sensors of one run.
    by
        What the rows are: poles, or sites of the same name.
    poles
        By pole, in the order of the first run's ranking, followed by those of the other runs; empty by site.
    sites
        Names of all sites, in the same order.
    agreements
        Agreement of each pair.
    sensors
        The best mount of each sensor; None with fewer than two sensors.
    differences
        Settings and files that differ.
    notes
        What a reader must know before comparing numbers.
    """

    runs: tuple[ComparedRun, ...]
    by: View
    poles: tuple[ComparedPole, ...]
    sites: tuple[str, ...]
    agreements: tuple[RankAgreement, ...]
    sensors: SensorComparison | None
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        labels = join_names([run.label for run in self.runs])
        count = len(self.poles) if self.by == "pole" else len(self.sites)
        text = f"Comparison({labels} by {self.by}, {count} {self.by}s"
        for pair in self.agreements[:1]:
            if pair.tau is not None:
                text += f"; {pair.shared} common to {pair.a} and {pair.b}, tau {pair.tau:.2f}"
        return f"{text})"


def compare_runs(
    folders: Sequence[Path | str],
    by: View | None = None,
    costs: Sequence[str] = (),
    progress: ProgressCallback = no_progress,
) -> Comparison:
    """Compare finished runs, or the sensors of one run.

    Parameters
    ----------
    folders
        Run folders; one is enough if it has several sensors.
    by
        Compare the best mounts of poles, or sites of the same name. By default sites if no pole has several sites and
        common sites have the same mount in all runs, or if only names agree; else poles.
    costs
        Overrides of the scenarios' ``[costs]``, e.g. ``'costs.sensor={"VLP-32C"=8000}'``.
    progress
        Called while sites are scored again for the errors of differences.

    Raises
    ------
    InputError
        If there is a single run with one sensor, a folder contains no finished run, its scores were changed, a cost is
        that of an unknown sensor, or the first run has no pole in common with any other.
    """
    runs = tuple(_read_run(Path(folder), run_label(number), costs) for number, folder in enumerate(folders))
    if not runs:
        raise InputError("compare", "expected at least one run, got none", "Give folders of finished runs.")
    compared = dict.fromkeys(sensor for run in runs for sensor in run.sensors)
    priced = costs_from_dict({}, costs, "--set").sensor
    check_sensor_names(priced, compared, "--set: costs.sensor")
    is_single = len(runs) == 1
    if is_single:
        runs = _split_by_sensor(runs[0], by)
    view = by or _choose_view(runs)
    if view == "pole" and not is_single:
        _check_common_poles(runs)

    pairs = list(combinations(runs, 2))
    notes: list[str] = []
    for a, b in pairs:
        notes += _notes(a, b, view)
    locations: dict[Location, None] = {}
    sites: dict[str, None] = {}
    for run in runs:
        sites |= dict.fromkeys(run.sites)
        if view == "pole":
            locations |= dict.fromkeys(run.poles)

    mounts = _sensor_mounts(runs)
    differences = ScoreDifferences.of(_sites_to_subtract(runs, locations, mounts), progress)
    notes += _error_notes(runs, differences)
    return Comparison(
        runs=runs,
        by=view,
        poles=tuple(_compare_pole(location, runs, differences) for location in locations),
        sites=tuple(sites),
        agreements=tuple(compare_rankings(a, b, view) for a, b in pairs),
        sensors=_compare_sensors(runs, mounts, differences),
        differences=tuple(find_differences(runs)),
        notes=tuple(dict.fromkeys(notes)),
    )


def check_distinct(folders: Sequence[Path]) -> None:
    """Check that no run folder is given twice, nor by a link.

    Parameters
    ----------
    folders
        Run folders.

    Raises
    ------
    InputError
        When two of them are the same folder.
    """
    given: dict[Path, Path] = {}
    for folder in folders:
        other = given.setdefault(folder.resolve(), folder)
        if other is not folder:
            names = str(folder) if other == folder else f"{other} and {folder}"
            raise InputError("compare", f"the same run twice, {names}", "Give each run folder once.")


def run_label(number: int) -> str:
    """Return A, B, ... Z, AA, AB, ... for the numbers from 0, as the columns of a spreadsheet."""
    prefix, last = divmod(number, 26)
    label = chr(ord("A") + last)
    return run_label(prefix - 1) + label if prefix else label


def _read_run(folder: Path, label: str, cost_overrides: Sequence[str]) -> ComparedRun:
    record = RunRecord.read(folder)
    path = folder / SCORES
    score_stage = record.stages.get("score")
    if score_stage is None:
        problem = "expected a finished run, but the stage score was not run"
        raise InputError(RunFolder(folder).run_record, problem, "Run egvs run first.")
    if files.hash_file(path) != score_stage.artefacts.get(SCORES):
        raise InputError(path, "was changed after the run", 'Repeat "egvs run".')
    metadata = parquet.read_metadata(path, "scores")

    compared = {key: value for key, value in record.scenario.items() if key not in _IGNORED_SETTINGS}
    placement = compared.get("placement", {})
    compared["placement"] = {key: value for key, value in placement.items() if f"placement.{key}" not in PLAN_REQUEST}
    settings = {**without_replaced(flatten_settings(compared)), "egvs (version)": record.egvs}
    if settings.get("score.gamma") == "auto":
        settings["score.gamma"] = metadata["gamma"]
    if "traffic" in record.stages and record.stages["traffic"].summary.get("sumo") is not None:
        settings["sumo (version)"] = record.stages["traffic"].summary["sumo"]

    artefacts = {name for stage in record.stages.values() for name in stage.artefacts}
    input_files: dict[str, str] = {}
    for name, stage in record.stages.items():
        if name not in ("check", "report"):
            input_files |= {file: digest for file, digest in stage.files.items() if file not in artefacts}
    costs = costs_from_dict(record.scenario, cost_overrides, str(RunFolder(folder).run_record))
    ranking = Ranking.read(path)
    unrated = _unrated_sensors(record.scenario, {site.sensor for site in ranking.sites})
    return ComparedRun(label, folder, ranking, settings, input_files, costs, unrated)


def _unrated_sensors(scenario: Mapping[str, Any], names: Collection[str]) -> tuple[str, ...]:
    """Return the user-defined sensors of a recorded scenario that have no rated range."""
    custom = scenario.get("sensors", {})
    return tuple(sorted(name for name in names if name in custom and custom[name].get("rated_range_m") is None))


def _split_by_sensor(run: ComparedRun, by: View | None) -> tuple[ComparedRun, ...]:
    """Return the sites with each sensor of a run as runs; InputError if it has one sensor."""
    if len(run.sensors) < 2:
        problem = f"expected a second run, because all sites of this one have the sensor {run.sensors[0]}"
        hint = "Give two or more run folders, or a run whose sites file names several sensors."
        raise InputError(run.folder, problem, hint)
    if by == "site":
        problem = "expected a second run: sites of one run have different names"
        raise InputError("--by site", problem, "Give two or more run folders, or use --by pole.")
    parts = []
    for number, sensor in enumerate(run.sensors):
        ranking = Ranking.of(site for site in run.ranking.sites if site.sensor == sensor)
        parts.append(replace(run, label=run_label(number), ranking=ranking))
    return tuple(parts)


def _choose_view(runs: Sequence[ComparedRun]) -> View:
    """Return the default of ``by``, see :func:`compare_runs`."""
    first, *others = runs
    if not any(first.poles.keys() & run.poles.keys() for run in others):
        return "site" if any(first.sites.keys() & run.sites.keys() for run in others) else "pole"
    if any(len(run.poles) < len(run.sites) for run in runs):
        return "pole"
    for run in others:
        if any(_has_moved(first, run, name) for name in first.sites.keys() & run.sites.keys()):
            return "pole"
        if first.poles.keys() & run.poles.keys() and not first.sites.keys() & run.sites.keys():
            return "pole"
    return "site"


def _has_moved(a: ComparedRun, b: ComparedRun, name: str) -> bool:
    """Whether a common site has another position, angle or sensor."""
    return _mount(a.sites[name]) != _mount(b.sites[name])


def _mount(site: RankedSite) -> tuple[float | str, ...]:
    return site.x_m, site.y_m, site.z_m, site.yaw_deg, site.pitch_deg, site.roll_deg, site.sensor


def _check_common_poles(runs: Sequence[ComparedRun]) -> None:
    """InputError if the first run has no pole in common with any other."""
    first, *others = runs
    if any(first.poles.keys() & run.poles.keys() for run in others):
        return
    problem = f"no pole in common with {others[0].folder}: no site of one run has the x and y of a site of the other"
    moved = _moved_poles(first, others[0])
    if moved:
        problem += f" ({list_first(moved, _NAMED)})"
    if len(others) > 1:
        problem += "; nor with the other runs"
    hint = "Compare runs with the same poles: the same scenario, or the same sites file with other sensors or heights."
    raise InputError(first.folder, problem, hint)


def _moved_poles(a: ComparedRun, b: ComparedRun) -> list[str]:
    """Return poles of the same name at different positions, with the distance."""
    locations_b = {pole.name: location for location, pole in b.poles.items()}
    moved = []
    for location, pole in a.poles.items():
        other = locations_b.get(pole.name)
        if other is not None and other != location:
            moved.append(f"{pole.name} is {math.dist(location, other):.2f} m away")
    return moved


def _sites_to_subtract(
    runs: Sequence[ComparedRun], locations: Mapping[Location, None], mounts: Sequence[SensorMount]
) -> list[SiteOfRun]:
    """Return the sites whose scores are subtracted from each other."""
    by_label = {run.label: run for run in runs}
    sites = [SiteOfRun(by_label[mount.run].folder, mount.site) for mount in mounts]
    first, *others = runs
    for run in others:
        if not _are_comparable(first, run):
            continue
        for location in locations:
            if location in first.poles and location in run.poles:
                sites.append(SiteOfRun(first.folder, first.poles[location].best))
                sites.append(SiteOfRun(run.folder, run.poles[location].best))
    return sites


def _compare_pole(location: Location, runs: Sequence[ComparedRun], differences: ScoreDifferences) -> ComparedPole:
    poles = [run.poles.get(location) for run in runs]
    name = next(pole.name for pole in poles if pole is not None)
    mounts = [None if pole is None else pole.best for pole in poles]
    gaps: list[ScoreDifference | None] = [None]
    for run, mount in zip(runs[1:], mounts[1:], strict=True):
        if mounts[0] is None or mount is None or not _are_comparable(runs[0], run):
            gaps.append(None)
        else:
            gaps.append(differences.between(SiteOfRun(run.folder, mount), SiteOfRun(runs[0].folder, mounts[0])))
    return ComparedPole(name, location, tuple(mounts), tuple(gaps))


def _sensor_mounts(runs: Sequence[ComparedRun]) -> tuple[SensorMount, ...]:
    """Return the best mount of each sensor of each run that can be compared with the first; none for one sensor."""
    mounts: list[SensorMount] = []
    for run in runs:
        if _are_comparable(runs[0], run):
            existing = run.settings.get("sites.existing_poles", ())
            mounts += best_mounts(run.ranking.sites, run.costs, run.label, existing)
    if len({mount.sensor for mount in mounts}) < 2:
        return ()
    return tuple(mounts)


def _compare_sensors(
    runs: Sequence[ComparedRun], mounts: Sequence[SensorMount], differences: ScoreDifferences
) -> SensorComparison | None:
    """Compare sensors; errors contain the interval of the losses of returns.

    A reflectivity anywhere in the interval, with equal probability, differs from the default, its low end, by
    1 / sqrt(3) of its width in the root mean square, and the score in proportion.
    """
    folders = {run.label: run.folder for run in runs}
    changes = _interval_changes(folders, mounts)

    def difference(mount: SensorMount, other: SensorMount) -> ScoreDifference:
        first, second = (SiteOfRun(folders[one.run], one.site) for one in (mount, other))
        change = changes.get((mount.run, mount.site.site), 0.0) - changes.get((other.run, other.site.site), 0.0)
        return differences.between(first, second).widened(abs(change) / math.sqrt(3.0))

    comparison = SensorComparison.of(mounts, difference)
    is_known = len(changes) == len({(mount.run, mount.site.site) for mount in mounts})
    has_interval = is_known and any(changes.values())  # nothing changes where losses are off
    if comparison is None or not has_interval:
        return comparison
    at_high = sorted(mounts, key=lambda mount: -mount.site.score - changes[mount.run, mount.site.site])
    order = tuple(dict.fromkeys(mount.sensor for mount in at_high))
    return replace(comparison, has_loss_interval=True, order_at_high_reflectivity=order)


def _interval_changes(folders: Mapping[str, Path], mounts: Sequence[SensorMount]) -> dict[tuple[str, str], float]:
    """Return the change of the score over the interval of the reflectivity, by run and site, where it is known."""
    sites: dict[str, dict[str, RankedSite]] = {}
    for mount in mounts:
        sites.setdefault(mount.run, {})[mount.site.site] = mount.site
    changes: dict[tuple[str, str], float] = {}
    for label, sites_of_run in sites.items():
        for name, change in (interval_changes(folders[label], sites_of_run) or {}).items():
            changes[label, name] = change
    return changes


def _are_comparable(a: ComparedRun, b: ComparedRun) -> bool:
    """Whether the scores that rank may be subtracted."""
    return a.rank_by == b.rank_by and not _differing_egvs_keys(a, b)


def _differing_egvs_keys(a: ComparedRun, b: ComparedRun) -> list[str]:
    """Return the settings that make EGVS in bits incomparable; nothing where another score ranks."""
    if a.rank_by != "egvs":
        return []
    return [key for key in _EGVS_KEYS if a.settings.get(key) != b.settings.get(key)]


def compare_rankings(a: ComparedRun, b: ComparedRun, by: View = "site") -> RankAgreement:
    """Compare the rankings of two runs.

    Parameters
    ----------
    a, b
        The runs; the regret is that of using the best pole or site of ``a``.
    by
        Compare poles by their best mounts, or sites of the same name.
    """
    ranked_a, ranked_b = _ranked(a, by), _ranked(b, by)
    shared = [key for key in ranked_a if key in ranked_b]
    if not shared:
        return RankAgreement(a.label, b.label, 0)
    scores_a = np.array([ranked_a[key][1] for key in shared])
    scores_b = np.array([ranked_b[key][1] for key in shared])
    names = [ranked_a[key][0] for key in shared]
    tau, rho = None, None
    if len(shared) > 1:
        tau = rank_agreement(scores_a, scores_b, "tau")
        rho = rank_agreement(scores_a, scores_b, "rho")
    best_a = tuple(names[index] for index in sorted(best_sites(scores_a, 1)))
    best_b = tuple(names[index] for index in sorted(best_sites(scores_b, 1)))
    return RankAgreement(a.label, b.label, len(shared), tau, rho, best_a, best_b, regret(scores_a, scores_b))


def _ranked(run: ComparedRun, by: View) -> dict[Location | str, tuple[str, float]]:
    """Return name and score of each pole, or of each site."""
    if by == "pole":
        return {location: (pole.name, pole.best.score) for location, pole in run.poles.items()}
    return {name: (name, site.score) for name, site in run.sites.items()}


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


def _notes(a: ComparedRun, b: ComparedRun, view: View) -> Iterator[str]:
    """Yield what a reader must know before comparing the numbers of two runs."""
    pair = f"{a.label} and {b.label}"
    if view == "pole":
        yield from _pole_notes(a, b)
    else:
        yield from _site_notes(a, b)
    if a.rank_by != b.rank_by:
        yield f"{a.label} ranks by {a.rank_by}, {b.label} by {b.rank_by}: compare ranks only"
        return
    if differing := _differing_egvs_keys(a, b):
        yield f"{pair} differ in {' and '.join(differing)}: compare ranks and shares, not bits"


def _pole_notes(a: ComparedRun, b: ComparedRun) -> Iterator[str]:
    pair = f"{a.label} and {b.label}"
    if not a.poles.keys() & b.poles.keys():
        yield f"{pair} have no pole in common, so their rankings cannot be compared"
    if moved := _moved_poles(a, b):
        names = list_first(moved, _NAMED)
        yield f"poles of the same name at different positions in {pair} count as different poles: {names}"


def _site_notes(a: ComparedRun, b: ComparedRun) -> Iterator[str]:
    pair = f"{a.label} and {b.label}"
    shared = [site for site in a.sites if site in b.sites]
    if not shared:
        hint = "; --by pole matches them by position" if a.poles.keys() & b.poles.keys() else ""
        yield f"{pair} have no site name in common, so their rankings cannot be compared{hint}"
    if moved := [site for site in shared if _has_moved(a, b, site)]:
        count = f"{number_of(len(moved), 'site')} {by_number(len(moved), 'has', 'have')}"
        yield f"{count} the same name in {pair} but another position, angle or sensor: {list_first(moved, _NAMED)}"


def _error_notes(runs: Sequence[ComparedRun], differences: ScoreDifferences) -> Iterator[str]:
    """Yield which differences have the errors of independent scores, and why."""
    first = runs[0]
    for run in runs[1:]:
        if not _are_comparable(first, run):
            continue
        if reason := differences.why_independent(first.folder, run.folder):
            yield (
                f"standard errors of differences between {first.label} and {run.label} "
                f"are those of independent scores: {reason}"
            )
