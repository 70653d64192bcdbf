"""What each site sees and misses, and its empty scan: the figures of two sites, and the data of all that may be chosen.

Steps, for each site that a reader may choose: march its beams once more; split the entropy, summed along z, into what
the beams cross and what they don't; note where beams end. The best and the last site are drawn. Of every site the
images' data is kept without palettes: the page joins both when a reader chooses another site, in its light or dark
colours. Where these are many, the images have fewer and larger pixels, so that the page stays small.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.core.grid import Grid
from pipeline.report import blindspots, wording
from pipeline.report.blindspots import Blindspots, BlindspotView
from pipeline.report.drawing import maps, raster
from pipeline.report.drawing.map_frame import Box, extent, shared_scale
from pipeline.report.drawing.maps import Backdrop, SiteView
from pipeline.report.drawing.raster import ColumnValues, IndexedImage
from pipeline.report.ranking import Ranking, ScoredSite
from pipeline.scoring.egvs import EntropyField
from pipeline.scoring.scorer import Scorer
from pipeline.scoring.visibility import Beams
from pipeline.stages.base import Workspace
from pipeline.stages.shared.scans import scans

_CELLS = 300
"""Cells of an empty scan's image from west to east."""

MANY = 40
"""Sites whose images are kept in full; of more, only those of the best and of the last."""

_PALETTES = {"field": raster.FIELD, "scan": raster.DOTS, "vehicles": raster.SHARES}
"""Of the images of a site, by the view that they belong to; those of no other view are of the field."""

_COARSE_CELLS, _COARSE_PIXELS = 150, 30_000
"""The same for many sites, and the pixels of a field's image."""


@dataclass(frozen=True)
class SitePanel:
    """The three figures of one site, SVG text, and what stands above and below them."""

    scored: ScoredSite
    seen: str
    missed: str
    scan: str
    caption: str
    vehicles: BlindspotView | None


@dataclass(frozen=True)
class SiteViews:
    """The panels of the best and of the last site, their colour scale, and ``data``: JSON from which the page draws
    those of any other; ``is_coarse`` where it draws them with larger pixels; a vehicle with so many ``points`` is seen,
    0 where that is not shown.
    """

    panels: tuple[SitePanel, ...]
    scale: str
    points: float
    data: str
    is_coarse: bool


@dataclass(frozen=True)
class _Seen:
    """What one site's beams cross, and where they end."""

    scored: ScoredSite
    crossed: NDArray[np.bool_]
    seen_bit: ColumnValues
    missed_bit: ColumnValues
    caption: str
    ends_m: NDArray[np.float64]


def site_views(
    work: Workspace, ranking: Ranking, choosable: Sequence[ScoredSite], scorer: Scorer, backdrop: Backdrop
) -> SiteViews:
    """Figures and data of the ``choosable`` sites; those of the best and of the last site are drawn."""
    grid, box, is_coarse = scorer.field.grid, extent(scorer.field.grid, choosable), len(choosable) > MANY
    peak = float(columns_of(scorer.field, np.ones(len(scorer.field.cells), dtype=np.bool_)).max())
    missed, panels = blindspots.read(work, choosable), dict[str, SitePanel]()
    choices: dict[str, dict[str, Any]] = {}
    for seen in _seen(work, choosable, scorer):
        images = _images(seen, peak, box, in_full=not is_coarse or seen.scored in ranking.extremes)
        choices[seen.scored.site] = _choice(seen, images, missed, box)
        if seen.scored in ranking.extremes:
            number = ranking.extremes.index(seen.scored)
            panels[seen.scored.site] = _panel(seen, grid, peak, images["scan"], missed, backdrop, box, f"view-{number}")
    drawn = tuple(panels[site.site] for site in ranking.extremes)
    data = {
        "sites": {site.site: choices[site.site] for site in choosable},
        "palettes": {look: {name: _text(palette[look]) for name, palette in _PALETTES.items()} for look in raster.LOOKS}
        | {"shade": _text(raster.SHADE_PALETTE)},
        "end": _text(raster.END),
    }
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")  # no name may end the script
    return SiteViews(
        drawn, shared_scale(peak, "Entropy in the column (bit)"), missed.points if missed else 0.0, text, is_coarse
    )


def _images(seen: _Seen, peak: float, box: Box, *, in_full: bool) -> dict[str, IndexedImage]:
    pixels, cells = (raster.MOST_PIXELS, _CELLS) if in_full else (_COARSE_PIXELS, _COARSE_CELLS)
    return {
        "seen": raster.field_image(seen.seen_bit, peak, pixels),
        "missed": raster.field_image(seen.missed_bit, peak, pixels),
        "scan": raster.dots_image(seen.ends_m, box, cells),
        "shade": raster.shade_image(np.logical_not(seen.crossed.any(axis=2)), pixels),
    }


def _seen(work: Workspace, choosable: Sequence[ScoredSite], scorer: Scorer) -> Iterator[_Seen]:
    """In the order of the scans."""
    by_name, field = {site.site: site for site in choosable}, scorer.field
    for scan in scans(work, by_name.keys()):
        scored, crossed = by_name[scan.site.name], scorer.hits(scan.beams) > 0
        here = crossed.ravel()[field.cells]
        caption = wording.site_caption(scored, int(here.sum()), len(here))
        yield _Seen(scored, crossed, columns_of(field, here), columns_of(field, ~here), caption, _ends_m(scan.beams))


def _ends_m(beams: Beams) -> NDArray[np.float64]:
    """Where beams end on something, x and y in the world frame, (n, 2); those that go on to the sensor's range end on
    nothing.
    """
    met = np.linalg.norm(beams.ends_m, axis=1) < beams.sensor.range_m * (1 - 1e-9)
    ends: NDArray[np.float64] = beams.ends_m[met, :2] + np.asarray(beams.pose.position_m[:2])
    return ends


def _choice(seen: _Seen, images: dict[str, IndexedImage], missed: Blindspots | None, box: Box) -> dict[str, Any]:
    """What the page needs to draw one site's figures itself."""
    plan, site = maps.view_plan(box), seen.scored
    more = {} if missed is None else {"vehicles": missed.choice(site.site, box)}
    images = images | ({} if missed is None else {"vehicles": missed.image(site.site)})
    return {
        "at": [round(plan.x(site.x_m), 1), round(plan.y(site.y_m), 1)],
        "share": [wording.share(site.entropy_seen), wording.share(1 - site.entropy_seen)],
        "caption": seen.caption,
        "images": {name: [_text(image.head), _text(image.data)] for name, image in images.items()},
        **more,
    }


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _panel(
    seen: _Seen,
    grid: Grid,
    peak: float,
    scan: IndexedImage,
    missed: Blindspots | None,
    backdrop: Backdrop,
    box: Box,
    prefix: str,
) -> SitePanel:
    site, view = seen.scored, SiteView(seen.scored, seen.crossed, backdrop, box)
    place = f"{site.site} at x = {site.x_m:g} m, y = {site.y_m:g} m"

    def figure(word: str, values: ColumnValues, share: float) -> str:
        alt = f"From above: the {share:.1%} of the entropy {word} by {place}."
        return maps.site_view(grid, values, peak, view, f"{prefix}-{word}", alt)

    drawn = figure("seen", seen.seen_bit, site.entropy_seen), figure("missed", seen.missed_bit, 1 - site.entropy_seen)
    ends = maps.scan_view(grid, scan, view, f"{prefix}-scan", f"From above: where the beams of {place} end.")
    vehicles = missed.view(site, grid, backdrop, box, f"{prefix}-vehicles") if missed else None
    return SitePanel(site, *drawn, ends, seen.caption, vehicles)


def columns_of(field: EntropyField, which: NDArray[np.bool_]) -> ColumnValues:
    """Entropy summed along z over some of the voxels, (nx, ny) bits; added up in the order of the voxels."""
    nx, ny, nz = field.grid.shape
    summed = np.bincount(field.cells[which] // nz, weights=field.per_cell_bit[which], minlength=nx * ny)
    return summed.astype(np.float64).reshape(nx, ny)
