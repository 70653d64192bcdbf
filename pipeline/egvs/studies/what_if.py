r"""The ranking with solids that are in the scene for a share of the time, for ``egvs what-if``.

For each table ``[what_if.NAME]``, the scenario runs as it is and with the solids of the table; traffic is the same and
comes from the cache, so only the static world, the scans and the scores are made again. With the score :math:`S_0` of a
site without the solids, :math:`S_1` with them, and the share :math:`q` of the time in which they are there, its
expected score is

.. math:: (1 - q) S_0 + q S_1

Errors are those of the same frames: the block jackknife leaves out the same groups of frames in both runs
(:mod:`egvs.studies.paired_errors`), and the replicates are mixed as the scores are. Traffic does not react: vehicles
drive through a solid that stands in their lane, and those hidden inside it count as missed.

Of several tables, each leaves its share of the score that the others leave, as if they were independent of each other:
:math:`S_0 \prod_i (1 + q_i (S_i - S_0) / S_0)`. This is never below 0, and never above what the worst table leaves.
Where solids of two tables hide the same vehicles, the true value is higher.

The solids are written to the run folders, as ``what_if_1.geojson`` and so on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egvs.artefacts.run_folder import RunFolder
from egvs.core.errors import InputError, check_list, parse_each
from egvs.core.grid import FloatArray
from egvs.core.numbers import number_or_nan, parse_decimal
from egvs.core.platform import relative_path
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.special import cosdg, sindg
from egvs.core.wording import format_percent, number_of
from egvs.drawing.basemap import solid_group
from egvs.effects import registry
from egvs.formats import spreadsheets
from egvs.results.command_entries import DIGEST_KEY, what_if_digest
from egvs.results.labels import ScoreLabel, format_probability, join_names
from egvs.results.ranking import RankedSite, Ranking
from egvs.results.sensors import ScoreDifference
from egvs.runs import run, run_names
from egvs.runs.command_results import add_to_report
from egvs.runs.run_sources import SettingsSource
from egvs.scenario.fields import MAX_COORDINATE_M
from egvs.scenario.model import Scenario
from egvs.scenario.settings import format_overrides
from egvs.scenario.what_if_config import WhatIfBox, WhatIfConfig
from egvs.scoring.standard_errors import ScoreUncertainty
from egvs.scoring.zones import region_bounds_m
from egvs.sensors.sensor import scenario_sensor
from egvs.sensors.sites import candidate_sites
from egvs.studies.footprint_files import read_document, write_if_changed
from egvs.studies.paired_errors import SiteReplicates, read_replicates
from egvs.traffic.class_sizes import class_sizes
from egvs.world import geolocation
from egvs.world.footprints import WORLD_DATUM, Z_DATUM, read_footprints

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

TABLE = "what_if"
TOGETHER = "all together"
BEST = 5
"""The best sites of each run are in the table of sites."""

VEHICLE_COLUMNS = ("x_m", "y_m", "yaw_deg", "type")
PARKED = "parked_vehicle"
"""Kind of the solids of parked vehicles."""


@dataclass(frozen=True)
class WhatIfRun:
    """A run with the solids of one table.

    Attributes
    ----------
    name
        Name of the table; empty for the scenario as it is.
    share
        Share of the time.
    scenario, folder
        The scenario with these solids, and the run folder.
    """

    name: str
    share: float
    scenario: Scenario
    folder: Path


@dataclass(frozen=True)
class SiteScores:
    """The scores of a site.

    Attributes
    ----------
    site
        Its name.
    before
        Without any of the solids.
    present
        With the solids of each table, in order; None where the site is not possible then.
    expected
        For each table, the mean over the time; for several tables, also that of all together. None where the site is
        not possible with the solids.
    """

    site: str
    before: float
    present: tuple[float | None, ...]
    expected: tuple[float | None, ...]


@dataclass(frozen=True)
class WhatIfAnswer:
    """What the solids of a table change.

    Attributes
    ----------
    name, share
        The table, and its share of the time; None for all tables together.
    best_before, best_present, best_expected
        The best site without the solids, with them, and on average over the time; ``best_present`` is empty for all
        tables together.
    change
        Expected score of ``best_before`` minus its score without the solids; None where that site is not possible with
        them.
    rival
        ``best_expected`` if that is another site than ``best_before``, else the site that most probably beats it on
        average over the time; empty without another site, or without errors.
    overtakes, overtook
        Probability that it truly does, and the one without the solids; None without errors.
    impossible
        Sites that are not possible with the solids.
    """

    name: str
    share: float | None
    best_before: str
    best_present: str
    best_expected: str
    change: ScoreDifference | None
    rival: str
    overtakes: float | None
    overtook: float | None
    impossible: tuple[str, ...]

    def conclusion(self) -> str:
        """Return one sentence: whether the best site changes."""
        if self.share is None:  # all together
            time = TOGETHER
        else:
            time = f"{self.name} ({format_percent(self.share, 0)} of the time)"
        if self.change is None:
            return f"{time}: {self.best_before} is not possible with these solids; {self.best_expected} is best then."
        if self.best_expected == self.best_before:
            text = f"{time}: {self.best_before} stays the best site"
            if self.overtakes is not None:
                text += f" (probability that {self.rival} is better: {format_probability(self.overtakes)}"
                if self.overtook is not None:
                    text += f", {format_probability(self.overtook)} without"
                text += ")"
            return f"{text}."
        text = f"{time}: {self.best_expected} becomes the best site instead of {self.best_before}"
        if self.overtakes is not None:
            text += f" (probability that it is better: {format_probability(self.overtakes)})"
        return f"{text}."


@dataclass(frozen=True)
class WhatIfResult:
    """The answers of all tables.

    Attributes
    ----------
    runs
        The scenario as it is, then one run for each table.
    answers
        One for each table, and with several tables one for all together.
    sites
        The sites that are among the best :data:`BEST` in any run or on average, best first.
    label
        Label of the score that ranks.
    best
        The best site of the scenario as it is.
    notes
        What a reader must know.
    """

    runs: tuple[WhatIfRun, ...]
    answers: tuple[WhatIfAnswer, ...]
    sites: tuple[SiteScores, ...]
    label: ScoreLabel
    best: RankedSite
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        bests = [f"{answer.name} {answer.best_expected}" for answer in self.answers]
        return f"WhatIfResult(best {self.best.site}; on average over the time with {', '.join(bests)})"


def what_if(
    path: str | Path,
    overrides: Sequence[str] = (),
    names: Sequence[str] = (),
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: run.StageListener = run.ignore_stage,
) -> WhatIfResult:
    """Run a scenario as it is and with the solids of its tables, compare the rankings, and add the answers to a report.

    Parameters
    ----------
    path
        The scenario, or a run, whose settings are used.
    overrides
        Further settings of all runs, as in :func:`egvs.load`.
    names
        Names of the tables; all when empty.
    jobs
        Number of threads; one per core when None. Results do not depend on it.
    progress, listener
        Called with the progress of stages, and when a stage begins or ends.

    Returns
    -------
    WhatIfResult
        The answers. Those in the report of the first run are the same.

    Raises
    ------
    InputError
        When the scenario or a file is wrong, or it has no such table.
    """

    def run_one(_: int, what_if_run: WhatIfRun) -> None:
        run.run(what_if_run.scenario, what_if_run.folder, jobs=jobs, progress=progress, listener=listener)

    if isinstance(path, Scenario):
        hint = "Use its folder, path=scenario.folder, and its settings as overrides."
        raise InputError("path", "expected the folder of a scenario or run, got a Scenario", hint)
    check_list("overrides", overrides)
    check_list("names", names)
    result = compare_runs(prepare_runs(Path(path), overrides, names), run_one)
    record_answers(result)
    return result


def record_answers(result: WhatIfResult) -> tuple[Path, ...]:
    """Write the answers into the folder of the run as it is, and add them to its report; return both files.

    Parameters
    ----------
    result
        From :func:`compare_runs`.
    """
    base, *others = result.runs
    entries = {}
    for answer in result.answers:
        tables = [other.name for other in others] if answer.name == TOGETHER else [answer.name]
        values = asdict(answer)
        del values["name"]
        entries[answer.name] = {
            **values,
            "impossible": list(answer.impossible),
            "conclusion": answer.conclusion(),
            "tables": tables,
            DIGEST_KEY: what_if_digest(base.scenario, tables),
        }
    return add_to_report(base.folder, RunFolder.what_if, entries)


def prepare_runs(path: Path, overrides: Sequence[str] = (), names: Sequence[str] = ()) -> tuple[WhatIfRun, ...]:
    """Return the runs of a scenario with the solids of its tables, and write the solids; nothing is run yet.

    Parameters
    ----------
    path
        The scenario, or a run, whose settings are used.
    overrides
        Further settings of all runs, as in :func:`egvs.load`.
    names
        Names of the tables; all when empty.

    Raises
    ------
    InputError
        When the scenario or a file is wrong, it has no such table, or all solids of a source are out of range.
    """
    source = SettingsSource(path)
    base = source.load_variant(overrides)
    tables = _chosen_tables(base, names)
    folder = source.folder(base) if not overrides else run_names.run_folder(base.name, base.overrides)
    documents = {name: solid_documents(base, name) for name in tables}
    for name in tables:
        check_positions(base, name)
    runs = [WhatIfRun("", 0.0, base, folder)]
    for name, table in tables.items():
        changed = run_names.run_folder(base.name, {**base.overrides, TABLE: name})
        files = []
        for number, document in enumerate(documents[name], start=1):
            file = changed / f"what_if_{number}.geojson"
            write_if_changed(file, document)
            files.append(relative_path(file.resolve(), base.folder.resolve()))
        replaced = base.statics.footprints if table.tree_scale is None else ()
        footprints = [*replaced, *files, *table.footprints]
        scenario = source.load_variant((*overrides, *format_overrides({"statics.footprints": footprints})))
        runs.append(WhatIfRun(name, table.share, scenario, changed))
    return tuple(runs)


def compare_runs(runs: Sequence[WhatIfRun], run_one: Callable[[int, WhatIfRun], None]) -> WhatIfResult:
    """Run the scenario as it is and with each table, and compare the rankings.

    Parameters
    ----------
    runs
        From :func:`prepare_runs`.
    run_one
        Brings one run up to date; called with its number, from 1.
    """
    for number, what_if_run in enumerate(runs, start=1):
        run_one(number, what_if_run)
    rankings = [Ranking.read(RunFolder(what_if_run.folder).scores) for what_if_run in runs]
    by_name = [{site.site: site for site in ranking.sites} for ranking in rankings]
    replicates: list[SiteReplicates | str] = []
    for what_if_run, sites in zip(runs, by_name, strict=True):
        replicates.append(read_replicates(what_if_run.folder, sites))
    best = rankings[0].best[0]
    notes = list(_error_notes(runs, replicates))

    mixes = [{number: runs[number].share} for number in range(1, len(runs))]
    if len(mixes) > 1:
        mixes.append({number: runs[number].share for number in range(1, len(runs))})
        notes.append(f"{TOGETHER}: each table leaves its share of the score, as if it were independent of the others")
    answers = [_answer(runs, by_name, replicates, shares, best.site) for shares in mixes]
    scored = [_site_scores(name, by_name, mixes) for name in by_name[0]]
    shown = [site for site in scored if _is_shown(site, scored)]
    order = sorted(shown, key=lambda site: -site.before)
    return WhatIfResult(tuple(runs), tuple(answers), tuple(order), best.by, best, tuple(notes))


def _chosen_tables(scenario: Scenario, names: Sequence[str]) -> dict[str, WhatIfConfig]:
    if not scenario.what_if:
        hint = "Add, for example, [what_if.deliveries] with share = 0.3 and boxes, vehicles or footprints."
        raise InputError(f"{scenario.file}: {TABLE}", "expected at least one table, got none", hint)
    for name in names:
        if name not in scenario.what_if:
            problem = f"the scenario has no table [{TABLE}.{name}]"
            raise InputError("--only", problem, f"Use one of {', '.join(scenario.what_if)}.")
    return {name: table for name, table in scenario.what_if.items() if not names or name in names}


def solid_documents(scenario: Scenario, name: str) -> list[dict[str, Any]]:
    """Return the footprints of a table as GeoJSON: vehicles and boxes, then all footprints with grown trees.

    Parameters
    ----------
    scenario
        The scenario.
    name
        Name of the table.

    Raises
    ------
    InputError
        When a file is wrong, or trees are to grow and the footprints have none.
    """
    table = scenario.what_if[name]
    key = f"{TABLE}.{name}"
    features = [_box_feature(box, f"{name}_{number}") for number, box in enumerate(table.boxes, start=1)]
    if table.vehicles is not None:
        boxes = read_vehicles(scenario.find(table.vehicles, f"{key}.vehicles"), scenario)
        features += [_box_feature(box, f"{name}_vehicle_{number}") for number, box in enumerate(boxes, start=1)]
    for file in table.footprints:
        scenario.find(file, f"{key}.footprints")
    documents: list[dict[str, Any]] = []
    if features:
        documents.append({"type": "FeatureCollection", "crs": None, "features": features})
    if table.tree_scale is None:
        return documents
    trees = 0
    for file in scenario.statics.footprints:
        document = read_document(scenario.find(file, "statics.footprints"))
        _check_tree_heights(document, scenario, f"{key}.tree_scale")
        grown, count = grow_trees(document, table.tree_scale)
        trees += count
        documents.append(grown)
    if not trees:
        problem = "no footprint of the scenario is a tree or a hedge"
        raise InputError(f"{scenario.file}: {key}.tree_scale", problem, "Leave it out, or use boxes.")
    return documents


def check_positions(scenario: Scenario, name: str) -> None:
    """Raise an InputError if no solid of a source of a table can be met by a beam that reaches the region of interest.

    Such a beam is never farther from the region than the range of its sensor. The sources are the boxes, the parked
    vehicles, and the footprints; coordinates in degrees or of another frame are found so.

    Parameters
    ----------
    scenario
        The scenario.
    name
        Name of the table.
    """
    import shapely

    table = scenario.what_if[name]
    key = f"{TABLE}.{name}"
    sources: dict[str, list[Any]] = {}
    if table.boxes:
        sources[f"{scenario.file}: {key}.boxes.0"] = [_box_shape(box) for box in table.boxes]
    if table.vehicles is not None:
        path = scenario.find(table.vehicles, f"{key}.vehicles")
        sources[f"{path}: row 1"] = [_box_shape(box) for box in read_vehicles(path, scenario)]
    if table.footprints:
        world = geolocation.scenario_georeference(scenario)
        paths = [scenario.find(file, f"{key}.footprints") for file in table.footprints]
        shapes = [each.polygon for path in paths for each in read_footprints(path, world).footprints]
        if shapes:
            sources[str(paths[0])] = shapes
    if not sources:
        return

    sensors = {site.sensor: f"site {site.name}" for site in candidate_sites(scenario)}
    range_m = max(scenario_sensor(sensor, scenario, where).range_m for sensor, where in sensors.items())
    (west_m, south_m), (east_m, north_m) = region_bounds_m(scenario)
    region = shapely.box(west_m, south_m, east_m, north_m)
    for where, shapes in sources.items():
        distances_m = shapely.distance(region, shapes)
        if distances_m.min() > range_m:
            problem = (
                f"none of {number_of(len(shapes), 'solid')} is within {range_m:g} m of the region of interest,"
                " the range of the"
                f" sensors; this one is {distances_m[0]:,.0f} m away"
            )
            region_text = f"x {west_m:g} to {east_m:g}, y {south_m:g} to {north_m:g}"
            raise InputError(where, problem, f"Use the world frame in metres; the region is {region_text}.")


def _box_shape(box: WhatIfBox) -> BaseGeometry:
    from shapely.geometry import shape

    return shape(_box_feature(box, "")["geometry"])


def read_vehicles(path: Path, scenario: Scenario) -> list[WhatIfBox]:
    """Read parked vehicles: a table with x_m, y_m (centre, world frame), yaw_deg and type.

    Raises
    ------
    InputError
        Naming file, line and value.
    """
    sizes = class_sizes(scenario.traffic)

    def parse(where: str, row: dict[str, str]) -> Iterator[WhatIfBox]:
        kind = row["type"]
        if kind not in sizes:
            problem = f"expected one of {', '.join(sizes)}, got {kind!r}"
            raise InputError(f"{where}: type", problem, "Use one of these, or add the kind to traffic.kinds.")
        columns = VEHICLE_COLUMNS[:3]
        x_m, y_m, yaw_deg = parse_each(columns, lambda name: _parse(row[name], f"{where}: {name}"), "vehicles")
        size = sizes[kind]
        extent = {"length_m": size.length_m, "width_m": size.width_m, "height_m": size.height_m}
        yield WhatIfBox(x_m=x_m, y_m=y_m, yaw_deg=yaw_deg, kind=PARKED, **extent)

    boxes = spreadsheets.parse_rows(path, partial(_check_vehicle_columns, path), parse)
    if not boxes:
        raise InputError(path, "expected at least one vehicle, got none", "Write one row per vehicle.")
    return boxes


def _check_vehicle_columns(path: Path, header: list[str]) -> list[str]:
    for column in VEHICLE_COLUMNS:
        if column not in header:
            raise InputError(path, f"the file has no column {column}", f"Columns: {', '.join(VEHICLE_COLUMNS)}.")
    return header


def _parse(text: str, where: str) -> float:
    value = number_or_nan(text, parse_decimal)
    if not abs(value) <= MAX_COORDINATE_M:
        raise InputError(where, f"expected a number, got {text!r}", "Use a number such as 8.5.")
    return value


def _box_feature(box: WhatIfBox, name: str) -> dict[str, Any]:
    """Return a box as a GeoJSON feature, world frame; corners to 1 micrometre."""
    along, across = 0.5 * box.length_m, 0.5 * box.width_m
    cos, sin = float(cosdg(box.yaw_deg)), float(sindg(box.yaw_deg))
    ring = []
    for u, v in ((along, across), (-along, across), (-along, -across), (along, -across), (along, across)):
        ring.append([round(box.x_m + u * cos - v * sin, 6), round(box.y_m + u * sin + v * cos, 6)])
    properties = {"name": name, "kind": box.kind, "height_m": box.height_m}
    return {"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [ring]}, "properties": properties}


def _check_tree_heights(document: Mapping[str, Any], scenario: Scenario, key: str) -> None:
    """Raise an InputError when the trees of a file have no heights above the ground that could be multiplied."""
    if registry.ground_effect(scenario) is None:
        return
    for feature in document["features"]:
        properties = feature.get("properties") if isinstance(feature, dict) else None
        if isinstance(properties, dict) and _is_tree(properties) and properties.get(Z_DATUM) == WORLD_DATUM:
            problem = f"expected trees with heights above the ground, got z of the world frame ({Z_DATUM} = 'world')"
            raise InputError(f"{scenario.file}: {key}", problem, "Use the footprints that were not exported.")


def _is_tree(properties: Any) -> bool:
    kind = properties.get("kind") if isinstance(properties, dict) else None
    return isinstance(kind, str) and solid_group(kind, math.inf) == "green"


def grow_trees(document: Mapping[str, Any], scale: float) -> tuple[dict[str, Any], int]:
    """Return a FeatureCollection in which trees and hedges are higher and wider, and their number.

    Heights and radii are multiplied; areas are scaled about their centre.

    Parameters
    ----------
    document
        GeoJSON.
    scale
        Factor.
    """
    from shapely import affinity
    from shapely.geometry import mapping, shape

    features, count = [], 0
    for feature in document["features"]:
        properties = feature.get("properties") if isinstance(feature, dict) else None
        if _is_tree(properties):
            count += 1
            properties = dict(feature["properties"])
            for key in ("height_m", "radius_m"):
                if isinstance(properties.get(key), int | float):
                    properties[key] = round(properties[key] * scale, 3)
            geometry = feature["geometry"]
            if geometry["type"] in ("Polygon", "MultiPolygon"):
                geometry = mapping(affinity.scale(shape(geometry), scale, scale, origin="centroid"))
            feature = {**feature, "geometry": geometry, "properties": properties}
        features.append(feature)
    return {**document, "features": features}, count


def _error_notes(runs: Sequence[WhatIfRun], replicates: Sequence[SiteReplicates | str]) -> Iterator[str]:
    """Yield why errors are unknown."""
    first = replicates[0]
    for what_if_run, result in zip(runs, replicates, strict=True):
        if isinstance(result, str):
            yield f"errors are unknown: {what_if_run.folder}: {result}"
        elif not isinstance(first, str) and not _are_paired(first, result):
            yield f"errors of {what_if_run.name} are unknown: its traffic is divided into other blocks"


def _are_paired(first: SiteReplicates, second: SiteReplicates) -> bool:
    frames = [[record.frames.tolist() for record in result.groups] for result in (first, second)]
    return frames[0] == frames[1]


def expected_values(before: FloatArray, present: Sequence[FloatArray], shares: Sequence[float]) -> FloatArray:
    """Return the mean over the time of scores, or of their replicates.

    Parameters
    ----------
    before
        Without solids, any shape.
    present
        With the solids of each table, the same shape each.
    shares
        Share of the time of each table.

    Examples
    --------
    >>> expected_values(np.array([0.8]), [np.array([0.4])], [0.25]).tolist()
    [0.7]
    >>> expected_values(np.array([0.8]), [np.array([0.4]), np.array([0.2])], [0.5, 1.0]).round(9).tolist()
    [0.15]
    """
    means = [before + share * (values - before) for share, values in zip(shares, present, strict=True)]
    expected, *others = means
    for mean in others:
        # without a score to lose, solids can only add
        left = np.divide(mean, before, out=np.zeros_like(mean), where=before != 0)
        expected = np.where(before != 0, expected * left, expected + mean)
    return expected


def _answer(
    runs: Sequence[WhatIfRun],
    by_name: Sequence[Mapping[str, RankedSite]],
    replicates: Sequence[SiteReplicates | str],
    shares: Mapping[int, float],
    best: str,
) -> WhatIfAnswer:
    """Compare the runs with the numbers in ``shares`` with the first."""
    name, share, best_present = TOGETHER, None, ""
    if len(shares) == 1:
        (number,) = shares
        name, share = runs[number].name, runs[number].share
        best_present = next(iter(by_name[number]))
    names = [site for site in by_name[0] if all(site in by_name[number] for number in shares)]
    impossible = tuple(site for site in by_name[0] if site not in names)
    if not names:
        raise InputError(f"{TABLE}.{name}", "expected a site that is possible with these solids, got none")
    before = np.array([by_name[0][site].score for site in names])
    present = [np.array([by_name[number][site].score for site in names]) for number in shares]
    expected = expected_values(before, present, list(shares.values()))
    best_expected = names[int(np.argmax(expected))]
    uncertainty = _uncertainty(replicates, shares, names)

    change, rival, overtakes, overtook = None, "", None, None
    if best in names:
        row, count = names.index(best), len(names)
        value = float(expected[row] - before[row])
        change = ScoreDifference(value)
        if uncertainty is not None:
            a, b = np.array([count + row]), np.array([row])
            better = float(uncertainty.beats(a, b)[0])
            change = ScoreDifference(value, float(uncertainty.differences(a, b).se[0]), better, is_paired=True)
            others = np.array([number for number in range(count) if number != row], dtype=np.int64)
            if len(others):
                chances = uncertainty.beats(count + others, np.full(len(others), count + row))
                first = int(np.argmax(chances))
                if best_expected != best:
                    first = int(np.flatnonzero(others == names.index(best_expected))[0])
                rival, overtakes = names[others[first]], float(chances[first])
                overtook = float(uncertainty.beats(others[first : first + 1], np.array([row]))[0])
    return WhatIfAnswer(name, share, best, best_present, best_expected, change, rival, overtakes, overtook, impossible)


def _uncertainty(
    replicates: Sequence[SiteReplicates | str], shares: Mapping[int, float], names: Sequence[str]
) -> ScoreUncertainty | None:
    """Return the errors of the scores before, then of the expected scores, in the order of ``names``.

    None where they are unknown.
    """
    first = replicates[0]
    if isinstance(first, str):
        return None
    rows = []
    longest = [record.autocorrelation_frames for record in first.groups]
    for number in shares:
        result = replicates[number]
        if isinstance(result, str) or not _are_paired(first, result):
            return None
        rows.append(_rows(result, names))
        longest = [max(time, new.autocorrelation_frames) for time, new in zip(longest, result.groups, strict=True)]
    before = _rows(first, names)
    expected = expected_values(before, rows, list(shares.values()))
    groups = [replace(record, autocorrelation_frames=time) for record, time in zip(first.groups, longest, strict=True)]
    return ScoreUncertainty.of(np.concatenate([before, expected]), groups, len(names))


def _rows(result: SiteReplicates, names: Sequence[str]) -> FloatArray:
    return result.values[[result.names.index(name) for name in names]]


def _site_scores(
    name: str, by_name: Sequence[Mapping[str, RankedSite]], mixes: Sequence[Mapping[int, float]]
) -> SiteScores:
    before = by_name[0][name].score
    present = tuple(sites[name].score if name in sites else None for sites in by_name[1:])
    expected: list[float | None] = []
    for shares in mixes:
        scores = [present[number - 1] for number in shares]
        if any(score is None for score in scores):
            expected.append(None)
            continue
        values = [np.array([score], dtype=np.float64) for score in scores]
        expected.append(float(expected_values(np.array([before]), values, list(shares.values()))[0]))
    return SiteScores(name, before, present, tuple(expected))


def _is_shown(site: SiteScores, sites: Sequence[SiteScores]) -> bool:
    """Whether a site is among the best :data:`BEST` by any column."""
    others = [(other.before, *other.present, *other.expected) for other in sites]
    for number, value in enumerate((site.before, *site.present, *site.expected)):
        better = [row[number] for row in others]
        if value is not None and sum(score is not None and score > value for score in better) < BEST:
            return True
    return False


def impossible_note(answer: WhatIfAnswer) -> str:
    """Return a note on the sites that are not possible with the solids; empty if all are."""
    if not answer.impossible:
        return ""
    return f"{answer.name}: not possible with these solids: {join_names(answer.impossible)}"
