"""How many beams of a site cross each voxel?

Steps: take the site's empty scan from ``scans.parquet`` (with ``scan.keep = false``: cast it instead), move it into the
grid's frame in float64, march every beam, count. Where the scan's rows are shares of beams, or effects of the score
stage act, the crossings are listed, weighted, and added up in whole multiples of 2**-32 instead."""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import tables
from pipeline.core.errors import InputError
from pipeline.core.grid import Grid
from pipeline.kernels import march
from pipeline.scenario.models import Scenario
from pipeline.world.mesh import read_ply

if TYPE_CHECKING:
    from pipeline.effects.registry import Effect

Hits = NDArray[np.uint32] | NDArray[np.int64]

FARTHEST_M = 2e7
"""From further away, float64 cannot tell whether a chord is longer than 1 micrometre."""

UNIT = 2**32
"""What a whole beam adds to a voxel where beams are weighted: weights are rounded to whole multiples of 2**-32."""


MOST_CROSSINGS = 2**31
"""More whole beams times voxels might add up to more than 64 bits hold, in units of 2**-32."""


@dataclass(frozen=True)
class Beams:
    """One site's empty scan, as the march needs it.

    Attributes
    ----------
    site
        What the scan's metadata says of the site.
    ends_m
        Where each piece ends, seen from the sensor along the world's axes, (n, 3) float64.
    weight
        The share of its beam that each row is, (n,) float64; None where every row is a whole beam.
    """

    site: dict[str, Any]
    ends_m: NDArray[np.float64]
    weight: NDArray[np.float64] | None = None


class Visibility:
    """Counts the hits of one site after another. Threads may share one.

    Attributes
    ----------
    unit
        What a whole beam adds to a voxel: 1 (counters are uint32), or ``UNIT`` where effects weight beams (int64).
    skipped
        Named effects of the score stage that cannot change a score, and why.
    """

    def __init__(self, scenario: Scenario, out: Path, grid: Grid) -> None:
        self._scenario, self._out, self._grid = scenario, out, grid
        live, self.skipped = acting(scenario, out)
        self._effects = tuple(_prepared(effect, scenario, out) for effect in live)
        self.unit = UNIT if live or _weighted_scans(scenario, out) else 1
        self._local = threading.local()

    def beams(self, only: Collection[str] | None = None) -> Iterator[Beams]:
        """The scans in the order of the sites; of the sites named in ``only``, or of all."""
        if self._scenario.scan.keep:
            return _kept(self._out / "scans.parquet", only)
        return _cast(self._scenario, self._out, only)

    def hits(self, beams: Beams) -> Hits:
        """Hits of one site in each voxel, flat, (nx * ny * nz,), in ``unit``; valid until this thread's next call."""
        hits = self._counters()
        o, d, shape = in_voxels(beams, self._grid)
        if self.unit == 1:
            march.count_hits(o, d, shape, self._grid.voxel_m, hits)
        else:
            self._add_weighted(beams, hits)
        return hits

    def _counters(self) -> Hits:
        """This thread's counters, set to 0."""
        if not hasattr(self._local, "hits"):
            kind = np.uint32 if self.unit == 1 else np.int64
            self._local.hits = np.zeros(int(np.prod(self._grid.shape)), dtype=kind)
        hits: Hits = self._local.hits
        hits.fill(0)
        return hits

    def _add_weighted(self, beams: Beams, hits: Hits) -> None:
        from pipeline.effects.registry import Detect, TransmitScore
        from pipeline.kernels.crossings import accumulate
        from pipeline.sensing import crossings, sensors

        place = f"site {beams.site['site']}"
        sensor = sensors.resolve(beams.site["sensor"], self._scenario.sensors, place)
        whole = float(len(beams.ends_m) if beams.weight is None else beams.weight.sum())
        if whole * (sum(self._grid.shape) + 3) >= MOST_CROSSINGS:  # no sum over voxels may leave 64 bits
            raise InputError(
                place, f"{whole:g} beams with effects", f"fewer than {MOST_CROSSINGS / (sum(self._grid.shape) + 3):g}"
            )
        for found in crossings.listed(beams.site, beams.ends_m, self._grid):
            share = np.ones(len(found.cells)) if beams.weight is None else beams.weight[found.rows][found.piece]
            for effect in self._effects:
                if isinstance(effect, Detect):
                    share = share * effect.detect(found.middle_m, sensor)
                elif isinstance(effect, TransmitScore):
                    share = share * effect.share(found)
            accumulate(found.cells, np.rint(share * UNIT).astype(np.int64), hits)


def hits_of(
    scenario: Scenario, out: Path, grid: Grid, sites: Collection[str]
) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Beams that cross each voxel, (nx, ny, nz) float64, with the site's name; for the named sites, in the order of the
    scans."""
    visibility = Visibility(scenario, out, grid)
    for beams in visibility.beams(sites):
        yield beams.site["site"], (visibility.hits(beams) / visibility.unit).reshape(grid.shape)


def in_voxels(beams: Beams, grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Sensor (3,), beams (n, 3) and shape (3,) as :mod:`pipeline.kernels.march` wants them; InputError for what no grid
    holds."""
    place = f"scans.parquet: site {beams.site['site']}"
    position_m = np.array([beams.site["x_m"], beams.site["y_m"], beams.site["z_m"]])
    o_m, ends_m = grid.to_grid_m(position_m), beams.ends_m
    with np.errstate(over="ignore"):
        o, d = o_m / grid.voxel_m, ends_m / grid.voxel_m
    if not (np.isfinite(o).all() and np.isfinite(d).all()):
        raise InputError(place, "a beam with an end that is no number", "finite metres")
    if np.abs(o_m).max() > FARTHEST_M:
        raise InputError(place, f"stands {np.abs(o_m).max():g} m from the grid", f"within {FARTHEST_M:g} m")
    if len(ends_m) > np.iinfo(np.uint32).max:
        raise InputError(place, f"{len(ends_m)} beams", "fewer than 2**32")
    return o, d, np.asarray(grid.shape, dtype=np.int64)


def _prepared(effect: Effect, scenario: Scenario, out: Path) -> Effect:
    from pipeline.effects.registry import TransmitScore

    return effect.prepare(scenario, out) if isinstance(effect, TransmitScore) else effect


def acting(scenario: Scenario, out: Path) -> tuple[tuple[Effect, ...], dict[str, str]]:
    """The effects of the score stage that can change a score, and why each other one that is named cannot.

    Nothing is imported when the scenario names none. ``out`` holds ``statics.ply``, which tells what an effect can act
    on."""
    if not scenario.effects:
        return (), {}
    from pipeline.effects import registry as effects
    from pipeline.sensing import sites

    return effects.acting(scenario, "score", read_ply(out / "statics.ply")[0], sites.of(scenario))


def _weighted_scans(scenario: Scenario, out: Path) -> bool:
    """Whether rows of the scans are shares of beams."""
    if not scenario.effects:
        return False
    if scenario.scan.keep:
        with tables.reader(out / "scans.parquet", "scans") as (file, _):
            return "weight" in file.schema_arrow.names
    from pipeline.sensing import scanner as survey

    return "effects" in survey.settings(scenario, out)


def _kept(path: Path, only: Collection[str] | None) -> Iterator[Beams]:
    with tables.reader(path, "scans") as (file, about):
        if file.num_row_groups != len(about["sites"]):
            raise InputError(path, f"{file.num_row_groups} row groups for {len(about['sites'])} sites", "one a site")
        wanted = [c for c in ("dx_m", "dy_m", "dz_m", "weight") if c in file.schema_arrow.names]
        for group, site in enumerate(about["sites"]):
            if only is None or site["site"] in only:
                table = tables.read_group(file, group, path, wanted)
                columns = {name: table.column(name).to_numpy() for name in wanted}
                ends = np.column_stack([columns[name] for name in ("dx_m", "dy_m", "dz_m")])
                yield Beams(site, ends, columns.get("weight"))


def _cast(scenario: Scenario, out: Path, only: Collection[str] | None) -> Iterator[Beams]:
    from pipeline.sensing import scanner as survey

    world, _ = read_ply(out / "statics.ply")
    surveyed = survey.Survey(scenario, world)
    for site in surveyed.sites:
        if only is None or site.site in only:
            done = surveyed.scan(site)
            yield Beams(done.about, done.scan.ends_m, done.scan.weight)
