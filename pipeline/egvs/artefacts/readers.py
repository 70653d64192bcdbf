"""Read the artefacts of a run folder as tables and arrays.

``blindspots.parquet`` as it is read: the map of each site, and its worst places in words.

Artefacts as arrays and tables, for notebooks, stages, and people who want to compute further.

Each reader checks what it reads and says which file is wrong. Tables come as Arrow tables (``.to_pandas()`` makes a
data frame of one), grids as NumPy arrays.

The ranking of the sites in each period, side by side with that of the mix.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from egvs.artefacts import checksums, parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import read_periods
from egvs.core.errors import InputError
from egvs.core.grid import Grid

MIN_VEHICLES = 10
"""Of fewer different vehicles nothing is said in words: a share of three cars is no fact about a lane."""

MAX_LOCATIONS = 5
"""The worst places that are listed of a site."""

_MAX_ROW_GROUPS = 1000
"""Row groups of a file; where there are more sites, some share one."""

_LISTED_KINDS = ("lane", "turn", "crossing")


@dataclass(frozen=True)
class LocationVisibility:
    """A place, and what a site sees there.

    Attributes
    ----------
    by, words
        As in the artefact.
    vehicle_frames, vehicles
        Vehicles there, counted in each frame; how many different ones.
    share, se
        Of them that is seen, 0 to 1, and its standard error; not a number of one vehicle.
    x_m, y_m
        Where they were on average, world frame.
    """

    by: str
    words: str
    x_m: float
    y_m: float
    vehicle_frames: int
    vehicles: int
    share: float
    se: float


@dataclass(frozen=True, eq=False)
class SiteBlindspots:
    """One site's rows.

    Attributes
    ----------
    site
        Its name.
    points
        A vehicle with so many points is seen.
    locations
        All but the squares, in the order of the artefact.
    share_missed
        Of the vehicles over each square, the share that is not seen, (nx, ny) float64; not a number where none was
        recorded.
    origin_m, cell_m
        The squares' south-western corner in the world frame, and their edge.
    """

    site: str
    points: float
    locations: tuple[LocationVisibility, ...]
    share_missed: NDArray[np.float64]
    origin_m: tuple[float, float]
    cell_m: float

    @property
    def overall(self) -> LocationVisibility | None:
        """All vehicles of the region; None where there are none."""
        return next((place for place in self.locations if place.by == "all"), None)

    @property
    def off_lanes(self) -> int:
        """Vehicle-frames that were on no lane."""
        return sum(place.vehicle_frames for place in self.locations if place.by == "no lane")

    def of_kind(self, *kinds: str) -> list[LocationVisibility]:
        """Places of some kinds with enough vehicles to speak of, the worst first."""
        found = [place for place in self.locations if place.by in kinds and place.vehicles >= MIN_VEHICLES]
        return sorted(found, key=lambda place: (place.share, -place.vehicle_frames, place.words))

    @property
    def worst(self) -> list[LocationVisibility]:
        """The lanes, ways through junctions and crossings that are seen worse than the region as a whole, the worst
        first; a handful at most."""
        mean = self.overall.share if self.overall else 0.0
        return [place for place in self.of_kind(*_LISTED_KINDS) if place.share < mean][:MAX_LOCATIONS]

    def in_words(self) -> str:
        """Where vehicles are missed, in one line, with the two worst places."""
        if self.overall is None:
            return f"no vehicle in the region of interest, so none that {self.site} misses"
        share = f"{self.site} misses {1.0 - self.overall.share:.1%} of the vehicles (fewer than {self.points:g} points)"
        worst = "; ".join(f"{place.words}, {place.share:.0%} seen" for place in self.worst[:2])
        return f"{share}; worst: {worst}" if worst else share


def read_blindspots(path: Path, only: Collection[str] | None = None) -> Iterator[SiteBlindspots]:
    """The sites in their order; those named in ``only``, or all.

    Raises
    ------
    InputError
        When the file is corrupt, or a row lies outside the region.
    """
    with parquet.open_artefact(path, "blindspots") as (file, about):
        names = [site["site"] for site in about["sites"]]
        at_once = sites_per_row_group(len(names))
        groups = [names[first : first + at_once] for first in range(0, len(names), at_once)]
        if file.num_row_groups != len(groups):
            right = "one a site" if at_once == 1 else f"one for {at_once} of them"
            raise InputError(path, f"{file.num_row_groups} row groups for {len(names)} sites", right)
        for number, group in enumerate(groups):
            if only is not None and not any(name in only for name in group):
                continue
            table = parquet.read_row_group(file, number, path)
            rows = table.num_rows // len(group)
            for place, name in enumerate(group):
                if only is None or name in only:
                    yield _site_blindspots(name, table.slice(place * rows, rows).to_pydict(), about, path)


def sites_per_row_group(sites: int) -> int:
    """How many sites share a row group: Arrow keeps more of a group than the rows of a site take."""
    return max(1, -(-sites // _MAX_ROW_GROUPS))


def _site_blindspots(
    site: str, columns: Mapping[str, list[Any]], metadata: Mapping[str, Any], path: Path
) -> SiteBlindspots:
    cells = metadata["cells"]
    share_missed = np.full(cells["shape"], np.nan)
    by, share = np.array(columns["by"], dtype=str), np.array(columns["share_seen"], dtype=np.float64)
    index = np.array([columns["ix"], columns["iy"]], dtype=np.int64)[:, by == "cell"]
    if index.size and not ((index >= 0) & (index < np.array([cells["shape"]]).T)).all():
        raise InputError(path, f"a square of site {site} lies outside the region", "an unaltered file; make it again")
    share_missed[tuple(index)] = 1.0 - share[by == "cell"]
    names = ("by", "words", "x_m", "y_m", "vehicle_frames", "vehicles", "share_seen", "share_se")
    rows = zip(*(columns[name] for name in names), strict=True)
    places = tuple(LocationVisibility(*row) for row in rows if row[0] != "cell")
    x, y = cells["origin_m"]
    return SiteBlindspots(site, metadata["points"], places, share_missed, (x, y), cells["cell_m"])


DISTINCT_PROBABILITY = 0.9
"""Neighbours in rank are told apart when the chance that the better is better (``beats_next``) reaches this."""


def read_scores(path: str | Path) -> pa.Table:
    """Read ``scores.parquet``."""
    return parquet.read_artefact(Path(path), "scores")[0]


def read_scores_by_period(path: str | Path) -> pa.Table:
    """Read ``scores_by_period.parquet``, which a run leaves where its traffic has periods."""
    return parquet.read_artefact(Path(path), "scores_by_period")[0]


def read_scans(path: str | Path) -> pa.Table:
    """Read ``scans.parquet``."""
    return parquet.read_artefact(Path(path), "scans")[0]


def read_accuracy(path: str | Path) -> tuple[list[dict[str, Any]], dict[str, Any]] | None:
    """Rows and metadata of ``accuracy.parquet``; None where there is none."""
    path = Path(path)
    if not path.is_file():
        return None
    checksums.verify_checksums(
        path.with_name(RunFolder.accuracy_checksums.name), "remove it, or run egvs accuracy again"
    )
    try:
        table, about = parquet.read_artefact(path, "accuracy")
    except InputError as error:
        raise InputError(path, "is no accuracy study", f"remove it, or run egvs accuracy again ({error})") from None
    return table.to_pylist(), about


def read_placement(
    placement: str | Path, curve: str | Path
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], dict[str, Any]] | None:
    """Rows of ``placement.parquet`` and of ``curve.parquet``, and their metadata; None where one of them is not there,
    or they are of different plans."""
    paths = Path(placement), Path(curve)
    if not all(path.is_file() for path in paths):
        return None
    checksums.verify_checksums(
        paths[0].with_name(RunFolder.placement_checksums.name), "remove it, or run egvs place again"
    )
    found = []
    for path in paths:
        try:
            found.append(parquet.read_artefact(path, path.stem))
        except InputError as error:
            raise InputError(path, "is no plan", f"remove it, or run egvs place again ({error})") from None
    (rows, about), (points, other) = found
    return None if about != other else (rows.to_pylist(), points.to_pylist(), about)


def read_validation(
    detection: str | Path, correlation: str | Path
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], dict[str, Any]] | None:
    """Rows of ``detection.parquet`` and of ``correlation.parquet``, and the latter's metadata; None where one of them
    is not there, or they are of different validations.
    """
    paths = Path(detection), Path(correlation)
    if not all(path.is_file() for path in paths):
        return None
    checksums.verify_checksums(
        paths[0].with_name(RunFolder.validation_checksums.name), "remove it, or run egvs validate again"
    )
    found = []
    for path in paths:
        try:
            found.append(parquet.read_artefact(path, path.stem))
        except InputError as error:
            right = f"remove it, or run egvs validate again ({error})"
            raise InputError(path, "is not what egvs validate writes", right) from None
    (detected, one), (correlated, about) = found
    return (detected.to_pylist(), correlated.to_pylist(), about) if one["inputs"] == about["inputs"] else None


def read_visibility(path: str | Path, site: str) -> NDArray[np.float64]:
    """Hits of one site in every voxel, (nx, ny, nz) float64, from ``visibility.parquet``."""
    path = Path(path)
    table, about = parquet.read_artefact(path, "visibility")
    mine = table.filter(pc.equal(table.column("site"), site))
    if len(mine) == 0 and site not in {s["site"] for s in about["sites"]}:
        raise InputError(path, f"no site {site!r}", "a site that score.keep_visibility names")
    hits = np.zeros(Grid.from_json(about["grid"]).shape)
    hits[tuple(mine.column(name).to_numpy() for name in ("ix", "iy", "iz"))] = mine.column("hits").to_numpy()
    return hits


@dataclass(frozen=True)
class PeriodRank:
    """A site in one period: its rank, and its score, the one that ranks, as a share of the best there; 0 where that is
    0."""

    rank: int
    of_best: float


@dataclass(frozen=True)
class PeriodRanking:
    """Sites by rank in the mix, and each of them in every period.

    ``shares`` are the periods' weights in the mix, adding up to 1; ``frames`` those recorded in all of them.
    """

    periods: tuple[str, ...]
    shares: tuple[float, ...]
    frames: int
    sites: tuple[tuple[str, int, tuple[PeriodRank, ...]], ...]

    @classmethod
    def read(cls, folder: Path) -> PeriodRanking | None:
        """From a run's folder; None where its traffic has no periods."""
        if not RunFolder(folder).scores_by_period.is_file():
            return None
        periods = read_periods(RunFolder(folder).tpog)
        table, about = parquet.read_artefact(RunFolder(folder).scores_by_period, "scores_by_period")
        rows, by = table.to_pylist(), about.get("rank_by", "egvs")
        most: dict[str, float] = {}
        for row in rows:
            most[row["period"]] = max(most.get(row["period"], 0.0), row[by])
        of_site: dict[str, list[PeriodRank]] = {}
        for row in rows:
            best = most[row["period"]]
            of_best = row[by] / best if best > 0 else 0.0
            of_site.setdefault(row["site"], []).append(PeriodRank(row["rank"], of_best))
        mix = sorted(read_scores(RunFolder(folder).scores).to_pylist(), key=lambda row: int(row["rank"]))
        weight = sum(period.weight for period in periods)
        return cls(
            tuple(period.name for period in periods),
            tuple(period.weight / weight for period in periods),
            sum(period.frames for period in periods),
            tuple((row["site"], row["rank"], tuple(of_site[row["site"]])) for row in mix),
        )
