"""A figure of a run for a paper or a slide, by the report's drawing code: SVG, PDF with its fonts in it, or PNG.

A figure is as wide as it is asked to be, and its letters are as large as a paper's: the map is drawn for that width,
not shrunk to it. Colours are those of light pages, viridis, which reads the same for every kind of colour vision.
"""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path

import numpy as np

from pipeline.artefacts.readers import Tpog, read_tpog
from pipeline.core import files, plugins
from pipeline.core.errors import InputError, MissingBackendError
from pipeline.core.progress import Progress, silent
from pipeline.export.exporting import FOLDER, file_name
from pipeline.export.finished_run import FinishedRun
from pipeline.export.paper.flat_svg import flat
from pipeline.report import figures
from pipeline.report.drawing import maps
from pipeline.report.drawing.map_frame import extent
from pipeline.report.drawing.maps import Backdrop, SiteView
from pipeline.report.drawing.ranking_chart import Bar, chart
from pipeline.report.ranking import Ranking, ScoredSite
from pipeline.report.site_views import columns_of
from pipeline.stages.shared.scans import scans
from pipeline.stages.shared.world import STATICS

WHAT = ("ranking", "map", "tpog", "seen", "missed")
OF_SITES = ("seen", "missed")
KINDS = ("pdf", "png", "svg")

DOTS_PER_INCH = 600
_FIRST_CHUNK = 33
"""Bytes of a PNG to the end of its first chunk."""
LETTERS_PT = 7.0
"""How large letters are on paper; 12 units of a figure."""

NARROWEST_MM, WIDEST_MM = 50.0, 1000.0
MOST_BARS = 40
"""Of a ranking the first ones are drawn."""


def draw(
    folder: Path,
    what: str,
    *,
    site: str | None = None,
    kind: str = "pdf",
    width_mm: float = 85.0,
    out: Path | None = None,
    progress: Progress = silent,
) -> Path:
    """Draw a figure of a finished run; its path.

    Parameters
    ----------
    what, kind
        One of :data:`WHAT`, and of :data:`KINDS`.
    site
        Of :data:`OF_SITES`: whose view is drawn; the best one's by default.
    out
        The file; in the run's folder ``export/WHAT.KIND`` by default.

    Raises
    ------
    InputError
        Names what is unknown, missing, damaged, or cannot be written; nothing is written then.
    """
    _check(what, site, kind, out)
    run = FinishedRun.open(folder)
    ranking = Ranking.read(run.artefact("scores.parquet"))
    chosen = _site(ranking, site)
    name = f"{what}_{file_name(chosen.site)}" if what in OF_SITES else what
    path = out or folder / FOLDER / f"{name}.{kind}"
    files.see_room(path)
    units = width_mm / 25.4 * 72.0 * 12.0 / LETTERS_PT
    svg = flat(_drawn(run, what, ranking, chosen, units), width_mm)
    progress("drawn", 1, 2)
    with files.aside(path) as partial:
        partial.write_bytes(_converted(svg, kind))
    progress("written", 2, 2)
    return path


def _check(what: str, site: str | None, kind: str, out: Path | None) -> None:
    for option, value, known in (("--what", what, WHAT), ("--format", kind, KINDS)):
        if value not in known:
            raise InputError(option, repr(value), f"one of {', '.join(known)}")
    if site is not None and what not in OF_SITES:
        raise InputError("--site", f"with --what {what}", f"--what {' or '.join(OF_SITES)}")
    if out is not None and out.suffix != f".{kind}":
        raise InputError("--out", repr(str(out)), f"a file that ends in .{kind} for --format {kind}")
    if kind != "svg":
        plugins.require(f"a figure as {kind}", "figure", "cairosvg")


def _site(ranking: Ranking, name: str | None) -> ScoredSite:
    if name is None:
        return ranking.best[0]
    found = next((its for its in ranking.sites if its.site == name), None)
    if found is None:
        some = ", ".join(its.site for its in ranking.sites[:10]) + (", ..." if len(ranking.sites) > 10 else "")
        raise InputError("--site", f"{name!r} is no site of this run", f"one of {some}")
    return found


def _drawn(run: FinishedRun, what: str, ranking: Ranking, site: ScoredSite, units: float) -> str:
    """SVG text, so many units wide."""
    if what == "ranking":
        return ranking_chart(ranking, units)
    run.artefact(STATICS)
    tpog = read_tpog(run.artefact("tpog.parquet"))
    backdrop = figures.backdrop_of(run.work, ranking, tpog)
    if what == "map":
        return figures.sites_map(tpog, ranking, backdrop, units)
    if what == "tpog":
        return figures.occupancy_map(tpog, ranking, backdrop, units)
    return _view(run, what, site, tpog, ranking, backdrop, units)


def _view(
    run: FinishedRun, what: str, site: ScoredSite, tpog: Tpog, ranking: Ranking, backdrop: Backdrop, units: float
) -> str:
    """What a site sees or misses of the entropy, SVG text."""
    scorer = run.scorer(tpog)
    field, scan = scorer.field, next(scans(run.work, (site.site,)))
    if not len(field.cells):
        raise InputError(f"--what {what}", "nothing is uncertain in this run", "a run with traffic in its region")
    crossed = scorer.hits(scan.beams) > 0
    here = crossed.ravel()[field.cells]
    peak = float(columns_of(field, np.ones(len(here), dtype=np.bool_)).max())
    view = SiteView(site, crossed, backdrop, extent(tpog.grid, ranking.sites))
    share = site.entropy_seen if what == "seen" else 1.0 - site.entropy_seen
    alt = f"From above: the {share:.1%} of the entropy {what} by {site.site}."
    values = columns_of(field, here if what == "seen" else ~here)
    label = f"Entropy in the column that {site.site} {'sees' if what == 'seen' else 'misses'} (bit)"
    return maps.site_view(tpog.grid, values, peak, view, what, alt, units, label)


def ranking_chart(ranking: Ranking, units: float) -> str:
    """The sites' scores as bars, SVG text."""
    by, shown = ranking.by, ranking.sites[:MOST_BARS]
    bars = [Bar(its.site, its.score, its.score_se, f"rank {its.rank}, {by.told(its.score)}") for its in shown]
    label = f"{by.label} (%)" if by.is_share else by.label
    alt = f"Ranking of {len(ranking.sites)} sites by {by.noun}; best: {ranking.best[0].site}."
    return chart(bars, label, alt, units, 100.0 if by.is_share else 1.0)


def _converted(svg: str, kind: str) -> bytes:
    """A figure as a file's content; it depends on no clock."""
    if kind == "svg":
        return svg.encode("utf-8")
    try:
        import cairosvg
    except OSError:  # the package is there, and the library that it calls is not
        told = f"a figure as {kind} needs the library cairo of the system (libcairo2); --format svg needs none"
        raise MissingBackendError(told) from None
    if kind == "png":
        return _with_size(cairosvg.svg2png(svg.encode("utf-8"), scale=DOTS_PER_INCH / 96.0, background_color="white"))
    pdf: bytes = cairosvg.svg2pdf(svg.encode("utf-8"))
    return re.sub(rb"(/CreationDate \(D:)[0-9]{14}", rb"\g<1>20000101000000", pdf)


def _with_size(png: bytes) -> bytes:
    """A PNG that says how large it is on paper: a chunk pHYs, in dots per metre, behind the first one.

    https://www.w3.org/TR/png-3/#11pHYs
    """
    dots = round(DOTS_PER_INCH / 0.0254)
    content = b"pHYs" + struct.pack(">IIB", dots, dots, 1)
    chunk = struct.pack(">I", len(content) - 4) + content + struct.pack(">I", zlib.crc32(content))
    return png[:_FIRST_CHUNK] + chunk + png[_FIRST_CHUNK:]
