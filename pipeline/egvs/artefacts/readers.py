"""Read the artefacts of a run folder: Arrow tables, NumPy arrays, blind spots of sites, rankings by period.

Each reader checks what it reads and names the file that is wrong. ``.to_pandas()`` makes a data frame of an Arrow
table.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa

from egvs.artefacts import checksums, parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import read_periods
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, Grid
from egvs.core.wording import format_percent

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

MIN_VEHICLES = 10
"""Locations with fewer different vehicles are not listed: a share of three cars says nothing about a lane."""

MAX_LOCATIONS = 5
"""Number of worst locations that are listed for a site."""

_MAX_ROW_GROUPS = 1000
"""Most row groups of a file; where there are more sites, some share a row group."""

_LISTED_KINDS = ("lane", "turn", "crossing")

_REMAKE_HINT = "Create the file again."

Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class LocationVisibility:
    """A location, and the vehicles there that are found from a site.

    Attributes
    ----------
    by, words
        Kind and name of the location, as in the artefact.
    x_m, y_m
        Mean position of the vehicles, world frame.
    vehicle_frames, vehicles
        Number of vehicles counted in each frame, and of different vehicles.
    share, se
        Share of the vehicles that detectors should find from the site, 0 to 1, and its standard error; NaN with one
        vehicle.
    """

    by: str
    words: str
    x_m: float
    y_m: float
    vehicle_frames: int
    vehicles: int
    share: float
    se: float

    def in_words(self) -> str:
        """Return the location, the share found with its standard error, and the number of vehicles, in one phrase."""
        share = format_percent(self.share, 0)
        if not math.isnan(self.se):
            share = f"{100 * self.share:.0f} ± {100 * self.se:.0f} %"
        return f"{self.words} ({share} of {self.vehicles:,} vehicles found)"


@dataclass(frozen=True, eq=False)
class SiteBlindspots:
    """The rows of one site in ``blindspots.parquet``.

    Attributes
    ----------
    site
        Name of the site.
    locations
        All locations except the cells of the map, in the order of the artefact.
    share_missed
        Share of the vehicles over each cell that the site misses, (nx, ny) float64; NaN where none was recorded.
    origin_m, cell_m
        South-western corner of the cells in the world frame, and their edge.
    """

    site: str
    locations: tuple[LocationVisibility, ...]
    share_missed: FloatArray
    origin_m: tuple[float, float]
    cell_m: float

    @property
    def overall(self) -> LocationVisibility | None:
        """All vehicles of the region; None where there are none."""
        for location in self.locations:
            if location.by == "all":
                return location
        return None

    @property
    def off_lanes(self) -> int:
        """Number of vehicle-frames that were on no lane."""
        return sum(location.vehicle_frames for location in self.locations if location.by == "no lane")

    def of_kind(self, *kinds: str) -> list[LocationVisibility]:
        """Return the locations of some kinds with at least :data:`MIN_VEHICLES` vehicles, the worst first."""
        selected = [loc for loc in self.locations if loc.by in kinds and loc.vehicles >= MIN_VEHICLES]
        return sorted(selected, key=lambda location: (location.share, -location.vehicle_frames, location.words))

    @property
    def worst(self) -> list[LocationVisibility]:
        """The lanes, turns and crossings where a smaller share is found than in the whole region, the worst first."""
        mean = self.overall.share if self.overall else 0.0
        worse = [location for location in self.of_kind(*_LISTED_KINDS) if location.share < mean]
        return worse[:MAX_LOCATIONS]

    def in_words(self) -> str:
        """Return in one line where the smallest share of the vehicles is found: the two worst locations."""
        if self.overall is None:
            return f"no vehicle in the region of interest, so none that {self.site} misses"
        if not self.worst:
            return (
                f"{self.site}: {format_percent(self.overall.share, 0)} of the vehicles are found, on no "
                "listed lane fewer"
            )
        worst = "; ".join(location.in_words() for location in self.worst[:2])
        return f"Of all lanes, turns and crossings, {self.site} finds the smallest shares of vehicles on: {worst}"


def read_blindspots(path: Path, only: Collection[str] | None = None) -> Iterator[SiteBlindspots]:
    """Yield the sites of ``blindspots.parquet`` in their order; those named in ``only``, or all.

    Raises
    ------
    InputError
        When the file is corrupt, or a row lies outside the region.
    """
    with parquet.open_artefact(path, "blindspots") as (file, metadata):
        names = [site["site"] for site in metadata["sites"]]
        group_size = sites_per_row_group(len(names))
        groups = [names[first : first + group_size] for first in range(0, len(names), group_size)]
        if file.num_row_groups != len(groups):
            problem = f"expected {len(groups)} row groups for {len(names)} sites, got {file.num_row_groups}"
            raise InputError(path, problem, _REMAKE_HINT)
        for number, group in enumerate(groups):
            if only is not None and not any(name in only for name in group):
                continue
            table = parquet.read_row_group(file, number, path)
            rows = table.num_rows // len(group)
            for position, name in enumerate(group):
                if only is None or name in only:
                    yield _site_blindspots(name, table.slice(position * rows, rows).to_pydict(), metadata, path)


def sites_per_row_group(sites: int) -> int:
    """Return how many sites share a row group: Arrow needs more memory for a group than for the rows of a site."""
    return max(1, -(-sites // _MAX_ROW_GROUPS))


def _site_blindspots(
    site: str, columns: Mapping[str, list[Any]], metadata: Mapping[str, Any], path: Path
) -> SiteBlindspots:
    cells = metadata["cells"]
    is_cell = np.array(columns["by"], dtype=str) == "cell"
    index = np.array([columns["ix"], columns["iy"]], dtype=np.int64)[:, is_cell]
    if index.size and not ((index >= 0) & (index < np.array([cells["shape"]]).T)).all():
        raise InputError(path, f"a cell of site {site} lies outside the region", _REMAKE_HINT)
    share_missed = np.full(cells["shape"], np.nan)
    share_missed[tuple(index)] = 1.0 - np.array(columns["share_found"], dtype=np.float64)[is_cell]

    names = ("by", "words", "x_m", "y_m", "vehicle_frames", "vehicles", "share_found", "share_found_se")
    rows = zip(*(columns[name] for name in names), strict=True)
    locations = tuple(LocationVisibility(*row) for row in rows if row[0] != "cell")
    x_m, y_m = cells["origin_m"]
    return SiteBlindspots(site, locations, share_missed, (x_m, y_m), cells["cell_m"])


ALL_USERS, PEDESTRIANS, TWO_WHEELERS = "all", "pedestrian", "two-wheeler"
"""Classes of road users in ``zones.parquet``; :data:`egvs.scoring.zone_results.CLASSES` has the others."""

_WHOLE_PERCENT = 0.95
"""Shares with a standard error below this have a decimal, in per cent."""

_CLASS_PLURALS = {
    ALL_USERS: "road users", "car": "cars", "truck": "trucks", "bus": "buses", "rail": "trams",
    TWO_WHEELERS: "two-wheelers", PEDESTRIANS: "pedestrians", "other": "others",
}  # fmt: skip


@dataclass(frozen=True)
class ZoneVisibility:
    """The road users of one class in one zone, and the share of them that is found.

    Attributes
    ----------
    zone, user_class
        Name of the zone; class of road users, as in the artefact.
    road_users, observations
        Number of different road users, and of observations of them.
    share, se
        Share that is expected to be found, 0 to 1, and its standard error; NaN with one road user.
    """

    zone: str
    user_class: str
    road_users: int
    observations: int
    share: float
    se: float

    @property
    def class_plural(self) -> str:
        """Plural of the class."""
        return _CLASS_PLURALS[self.user_class]

    @property
    def share_text(self) -> str:
        """The share with its standard error, where it is known."""
        if math.isnan(self.se):
            return format_percent(self.share, 0)
        digits = 0 if 100 * self.se >= _WHOLE_PERCENT else 1
        return f"{100 * self.share:.{digits}f} ± {100 * self.se:.{digits}f} %"

    def in_words(self) -> str:
        """Return zone, class, share and number of road users in one phrase."""
        return f"{self.zone}, {self.share_text} of {self.road_users:,} {self.class_plural}"


def read_zones(path: Path, site: str) -> list[ZoneVisibility]:
    """Return the rows of one site in ``zones.parquet``, in their order.

    Raises
    ------
    InputError
        When the file is corrupt.
    """
    import pyarrow.compute as pc

    table = parquet.read_artefact(path, "zones")[0]
    return _zone_rows(table.filter(pc.equal(table.column("site"), site)))


def read_zone_areas(path: Path) -> dict[str, BaseGeometry]:
    """Return the areas of the zones in ``zones.parquet`` by name, world frame, in the order of their file.

    Raises
    ------
    InputError
        When the file is corrupt.
    """
    import shapely

    metadata = parquet.read_metadata(path, "zones")
    try:
        return {name: shapely.from_wkb(area) for name, area in metadata["zones"]}
    except (TypeError, ValueError, shapely.errors.ShapelyError) as error:
        raise InputError(path, f"invalid areas in the metadata ({error})", _REMAKE_HINT) from None


def read_plan_zones(path: Path) -> list[ZoneVisibility]:
    """Return the rows of ``plan_zones.parquet``; :func:`read_zones` describes them."""
    return _zone_rows(parquet.read_artefact(path, "plan_zones")[0])


def _zone_rows(table: pa.Table) -> list[ZoneVisibility]:
    names = ("zone", "class", "road_users", "observations", "share_found", "share_found_se")
    columns = table.to_pydict()
    return [ZoneVisibility(*row) for row in zip(*(columns[name] for name in names), strict=True)]


def worst_zones(rows: Sequence[ZoneVisibility]) -> list[ZoneVisibility]:
    """Return where fewest road users are found: of pedestrians, of two-wheelers, and of all vehicles on more wheels.

    The zone with the smallest share of each, among zones with at least :data:`MIN_VEHICLES` of them.
    """
    groups: dict[str, list[ZoneVisibility]] = {PEDESTRIANS: [], TWO_WHEELERS: [], "": []}
    for row in rows:
        if row.road_users >= MIN_VEHICLES and row.user_class != ALL_USERS:
            groups[row.user_class if row.user_class in groups else ""].append(row)
    return [min(group, key=lambda row: (row.share, row.zone)) for group in groups.values() if group]


def describe_worst_zones(finder: str, worst: Sequence[ZoneVisibility]) -> str:
    """Return in one line where a site or a plan finds the smallest shares.

    Parameters
    ----------
    finder
        Name of the site, or "the plan".
    worst
        From :func:`worst_zones`.
    """
    listed = "; ".join(zone.in_words() for zone in worst)
    return f"Of all zones and classes of road users, {finder} finds the smallest shares in: {listed}"


DISTINCT_PROBABILITY = 0.9
"""Neighbours in rank are distinct when the probability that the better one is better (``beats_next``) reaches this."""


def read_scores(path: str | Path) -> pa.Table:
    """Read ``scores.parquet``."""
    return parquet.read_artefact(Path(path), "scores")[0]


def read_scores_by_period(path: str | Path) -> pa.Table:
    """Read ``scores_by_period.parquet``, which a run writes where its traffic has periods."""
    return parquet.read_artefact(Path(path), "scores_by_period")[0]


def read_scans(path: str | Path) -> pa.Table:
    """Read ``scans.parquet``."""
    return parquet.read_artefact(Path(path), "scans")[0]


def read_accuracy(path: str | Path) -> tuple[Rows, dict[str, Any]] | None:
    """Return the rows and the metadata of ``accuracy.parquet``; None if the file does not exist."""
    path = Path(path)
    if not path.is_file():
        return None
    study = read_study([path], RunFolder.accuracy_checksums.name, "an accuracy study", "egvs accuracy")
    return study[0]


def read_placement(placement: str | Path, curve: str | Path) -> tuple[Rows, Rows, dict[str, Any]] | None:
    """Return the rows of ``placement.parquet`` and of ``curve.parquet``, and their metadata.

    None where one of them does not exist, or they belong to different plans.
    """
    paths = [Path(placement), Path(curve)]
    if not all(path.is_file() for path in paths):
        return None
    (rows, metadata), (points, curve_metadata) = read_study(
        paths, RunFolder.placement_checksums.name, "a plan", "egvs place"
    )
    if metadata != curve_metadata:
        return None
    return rows, points, metadata


def read_study(paths: list[Path], checksum_file: str, what: str, command: str) -> list[tuple[Rows, dict[str, Any]]]:
    """Return the rows and the metadata of each file of a study.

    Parameters
    ----------
    paths
        The files, in one folder. Their names are those of their schemas.
    checksum_file
        Name of the file with their checksums, beside them.
    what, command
        The study and the command that makes it, for messages: "a plan", "egvs place".

    Raises
    ------
    InputError
        When a file was changed, or is corrupt.
    """
    checksums.verify_checksums(paths[0].with_name(checksum_file), f"Remove it, or run {command} again.")
    study = []
    for path in paths:
        try:
            table, metadata = parquet.read_artefact(path, path.stem)
        except InputError as error:
            raise InputError(path, f"is not {what} ({error})", f"Remove it, or run {command} again.") from None
        study.append((table.to_pylist(), metadata))
    return study


def read_visibility(path: str | Path, site: str) -> FloatArray:
    """Return the hits of one site in every voxel, (nx, ny, nz) float64, from ``visibility.parquet``."""
    import pyarrow.compute as pc  # a slow import, which only this function needs

    path = Path(path)
    if not path.exists():
        hint = f'Run with score.keep_visibility = ["{site}"], or "all": only then it is written.'
        raise InputError(path, "no such file", hint)
    table, metadata = parquet.read_artefact(path, "visibility")
    rows = table.filter(pc.equal(table.column("site"), site))
    if len(rows) == 0 and site not in {entry["site"] for entry in metadata["sites"]}:
        raise InputError(path, f"there is no site {site!r}", "Use a site listed in score.keep_visibility.")
    hits = np.zeros(Grid.from_json(metadata["grid"]).shape)
    hits[tuple(rows.column(name).to_numpy() for name in ("ix", "iy", "iz"))] = rows.column("hits").to_numpy()
    return hits


@dataclass(frozen=True)
class PeriodRank:
    """A site in one period: its rank, and its score as a share of the best there; 0 where the best is 0."""

    rank: int
    of_best: float


class SitePeriodRanks(NamedTuple):
    """A site, its rank in the mix, and its ranks in the periods."""

    site: str
    rank: int
    by_period: tuple[PeriodRank, ...]


@dataclass(frozen=True)
class PeriodRanking:
    """Sites by rank in the mix, and each of them in every period.

    Attributes
    ----------
    periods
        Names of the periods.
    shares
        Their weights in the mix, with the sum 1.
    frames
        Number of frames recorded in all periods.
    sites
        One entry per site, the best first.
    """

    periods: tuple[str, ...]
    shares: tuple[float, ...]
    frames: int
    sites: tuple[SitePeriodRanks, ...]

    @classmethod
    def read(cls, folder: Path) -> PeriodRanking | None:
        """Read it from a run folder; None where the traffic has no periods."""
        run_folder = RunFolder(folder)
        if not run_folder.scores_by_period.is_file():
            return None
        periods = read_periods(run_folder.tpog)
        table, metadata = parquet.read_artefact(run_folder.scores_by_period, "scores_by_period")
        rows = table.to_pylist()
        rank_by = metadata.get("rank_by", "egvs")
        best: dict[str, float] = {}
        for row in rows:
            best[row["period"]] = max(best.get(row["period"], 0.0), row[rank_by])
        ranks: dict[str, list[PeriodRank]] = {}
        for row in rows:
            best_score = best[row["period"]]
            share = row[rank_by] / best_score if best_score > 0 else 0.0
            ranks.setdefault(row["site"], []).append(PeriodRank(row["rank"], share))

        sites = []
        for row in sorted(read_scores(run_folder.scores).to_pylist(), key=lambda row: int(row["rank"])):
            sites.append(SitePeriodRanks(row["site"], row["rank"], tuple(ranks[row["site"]])))
        names = tuple(period.name for period in periods)
        weights = [period.weight for period in periods]
        shares = tuple(weight / sum(weights) for weight in weights)
        return cls(names, shares, sum(period.frames for period in periods), tuple(sites))
