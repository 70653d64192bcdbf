"""Rules for recorded traffic: what can be told only when vehicles have driven.

The stages that see the record ask them: how many vehicles are in the region of interest, whether they drive through
solids, and, where no network tells the lanes, whether sites stand where they drive.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import tables
from pipeline.core.findings import Finding
from pipeline.core.grid import Grid
from pipeline.scenario.models import FILE
from pipeline.world import limits
from pipeline.world.mesh import World

if TYPE_CHECKING:
    from pipeline.artefacts.readers import Tpog
    from pipeline.sensing.sites import Site


def in_region(boxes: float, trajectories: Path) -> Iterator[Finding]:
    """A warning where fewer than two vehicles are in the region of interest in a mean frame.

    Where there is none at all, ``trajectories.parquet`` is asked where they are instead.
    """
    if boxes >= limits.FEW_BOXES:
        return
    if boxes == 0:
        what = f"no vehicle is ever in it{_extent(trajectories)}: the sites cannot be ranked"
        cure = "a region where vehicles drive, more traffic, or coordinates of one frame"
        yield Finding("traffic in the region", "roi", what, cure)
    else:
        cure = "more vehicles in [traffic], or a region that holds more of the road"
        what = f"{boxes:.2g} vehicles are in it in a mean frame: the ranking rests on hardly any traffic"
        yield Finding("traffic in the region", "roi", what, cure)


def periods_without(boxes: Mapping[str, float]) -> Iterator[Finding]:
    """A warning for each period in which no vehicle is ever in the region, where one is in another; mean boxes a frame
    by period.
    """
    for period in (name for name, mean in boxes.items() if mean == 0 and any(boxes.values())):
        what = "no vehicle is ever in the region of interest: it adds nothing to the mix but certainty"
        cure = "coordinates of one frame for all periods, or traffic that comes by"
        yield Finding("traffic in the region", f"{FILE}: traffic.periods ({period})", what, cure)


def through_solids(
    hidden: NDArray[np.int64], seen: int, voxels: NDArray[np.int64], grid: Grid, world: World
) -> Iterator[Finding]:
    """A warning where vehicles occupy what static geometry fills.

    Parameters
    ----------
    hidden
        In how many frames each voxel that static geometry fills is occupied, (k,).
    seen
        The same, summed over all other voxels.
    voxels
        Which voxels static geometry fills, (k,), positions in the flattened grid.
    """
    share = int(hidden.sum()) / max(1, int(hidden.sum()) + seen)
    if share <= limits.THROUGH_SOLIDS:
        return
    worst = np.array(np.unravel_index(voxels[int(np.argmax(hidden))], grid.shape))
    at_m = np.asarray(grid.origin_m) + (worst + 0.5) * grid.voxel_m
    spot, name = ", ".join(f"{value:.1f}" for value in at_m), _solid_at(world, at_m, grid.voxel_m)
    what = f"{share:.1%} of what vehicles occupy lies in solids, most often at ({spot})"
    cure = "move the solids, or look at the coordinates of both"
    yield Finding("traffic through solids", "statics", what + (f", in {name}" if name else ""), cure)


def on_the_road(sites: Iterable[Site], tpog: Tpog) -> Iterator[Finding]:
    """A warning for each site that stands, no higher than the clearance, where vehicles drive in some frame."""
    grid, cure = tpog.grid, f"a place beside the road, or more than {limits.CLEARANCE_M:g} m above it"
    for site in sites:
        at_m = np.array(site.pose.position_m)
        ix, iy, _ = np.floor((at_m - grid.origin_m) / grid.voxel_m).astype(np.int64)
        if not (0 <= ix < grid.shape[0] and 0 <= iy < grid.shape[1]):
            continue
        column = tpog.counts[ix, iy]
        layers = np.flatnonzero(column)
        if len(layers) and at_m[2] - (grid.origin_m[2] + layers[0] * grid.voxel_m) <= limits.CLEARANCE_M:
            often = f"in {column.max() / tpog.frames:.1%} of the frames"
            what = f"vehicles are where it stands, at ({at_m[0]:g}, {at_m[1]:g}), {often}"
            yield Finding("sites on the road", f"site {site.name}", what, cure)


def _extent(trajectories: Path) -> str:
    """Where recorded vehicles are, in words; nothing where there is none."""
    table, _ = tables.read(trajectories, "trajectories", ["x_m", "y_m"])
    if not table.num_rows:
        return ""
    (x0, x1), (y0, y1) = ((c.min(), c.max()) for c in (table.column(name).to_numpy() for name in ("x_m", "y_m")))
    return f", all are between ({x0:.0f}, {y0:.0f}) and ({x1:.0f}, {y1:.0f})"


def _solid_at(world: World, at_m: NDArray[np.float64], within_m: float) -> str:
    """The first solid whose triangles come so near to a place along each axis that they may fill its voxel."""
    corners = world.triangles_m
    near = (corners.min(axis=1) <= at_m + within_m).all(axis=1) & (corners.max(axis=1) >= at_m - within_m).all(axis=1)
    names = [world.solids[solid] for solid in np.unique(world.solid_of_face[near])]
    return next((f"{name} ({kind})" for name, kind in names if kind != "ground"), "")
