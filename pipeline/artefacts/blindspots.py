"""``blindspots.parquet`` as it is read: the map of each site, and its worst places in words."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import tables
from pipeline.core.errors import InputError

BLINDSPOTS = "blindspots.parquet"

FEWEST_VEHICLES = 10
"""Of fewer different vehicles nothing is said in words: a share of three cars is no fact about a lane."""

MOST_PLACES = 5
"""The worst places that are listed of a site."""

_MOST_GROUPS = 1000
"""Row groups of a file; where there are more sites, some share one."""

_LISTED = ("lane", "turn", "crossing")


@dataclass(frozen=True)
class PlaceSeen:
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
    places
        All but the squares, in the order of the artefact.
    share_missed
        Of the vehicles over each square, the share that is not seen, (nx, ny) float64; not a number where none was
        recorded.
    origin_m, cell_m
        The squares' south-western corner in the world frame, and their edge.
    """

    site: str
    points: float
    places: tuple[PlaceSeen, ...]
    share_missed: NDArray[np.float64]
    origin_m: tuple[float, float]
    cell_m: float

    @property
    def whole(self) -> PlaceSeen | None:
        """All vehicles of the region; None where there are none."""
        return next((place for place in self.places if place.by == "all"), None)

    @property
    def off_lanes(self) -> int:
        """Vehicle-frames that were on no lane."""
        return sum(place.vehicle_frames for place in self.places if place.by == "no lane")

    def of_kind(self, *kinds: str) -> list[PlaceSeen]:
        """Places of some kinds with enough vehicles to speak of, the worst first."""
        found = [place for place in self.places if place.by in kinds and place.vehicles >= FEWEST_VEHICLES]
        return sorted(found, key=lambda place: (place.share, -place.vehicle_frames, place.words))

    @property
    def worst(self) -> list[PlaceSeen]:
        """The lanes, ways through junctions and crossings that are seen worse than the region as a whole, the worst
        first; a handful at most."""
        mean = self.whole.share if self.whole else 0.0
        return [place for place in self.of_kind(*_LISTED) if place.share < mean][:MOST_PLACES]

    def in_words(self) -> str:
        """Where vehicles are missed, in one line, with the two worst places."""
        if self.whole is None:
            return f"no vehicle in the region of interest, so none that {self.site} misses"
        share = f"{self.site} misses {1.0 - self.whole.share:.1%} of the vehicles (fewer than {self.points:g} points)"
        worst = "; ".join(f"{place.words}, {place.share:.0%} seen" for place in self.worst[:2])
        return f"{share}; worst: {worst}" if worst else share


def read(path: Path, only: Collection[str] | None = None) -> Iterator[SiteBlindspots]:
    """The sites in their order; those named in ``only``, or all.

    Raises
    ------
    InputError
        When the file is corrupt, or a row lies outside the region.
    """
    with tables.reader(path, "blindspots") as (file, about):
        names = [site["site"] for site in about["sites"]]
        at_once = sites_a_group(len(names))
        groups = [names[first : first + at_once] for first in range(0, len(names), at_once)]
        if file.num_row_groups != len(groups):
            right = "one a site" if at_once == 1 else f"one for {at_once} of them"
            raise InputError(path, f"{file.num_row_groups} row groups for {len(names)} sites", right)
        for number, group in enumerate(groups):
            if only is not None and not any(name in only for name in group):
                continue
            table = tables.read_group(file, number, path)
            rows = table.num_rows // len(group)
            for place, name in enumerate(group):
                if only is None or name in only:
                    yield _of_site(name, table.slice(place * rows, rows).to_pydict(), about, path)


def sites_a_group(sites: int) -> int:
    """How many sites share a row group: Arrow keeps more of a group than the rows of a site take."""
    return max(1, -(-sites // _MOST_GROUPS))


def _of_site(site: str, columns: Mapping[str, list[Any]], about: Mapping[str, Any], path: Path) -> SiteBlindspots:
    cells = about["cells"]
    share_missed = np.full(cells["shape"], np.nan)
    by, share = np.array(columns["by"], dtype=str), np.array(columns["share_seen"], dtype=np.float64)
    index = np.array([columns["ix"], columns["iy"]], dtype=np.int64)[:, by == "cell"]
    if index.size and not ((index >= 0) & (index < np.array([cells["shape"]]).T)).all():
        raise InputError(path, f"a square of site {site} lies outside the region", "an unaltered file; make it again")
    share_missed[tuple(index)] = 1.0 - share[by == "cell"]
    names = ("by", "words", "x_m", "y_m", "vehicle_frames", "vehicles", "share_seen", "share_se")
    rows = zip(*(columns[name] for name in names), strict=True)
    places = tuple(PlaceSeen(*row) for row in rows if row[0] != "cell")
    x, y = cells["origin_m"]
    return SiteBlindspots(site, about["points"], places, share_missed, (x, y), cells["cell_m"])
