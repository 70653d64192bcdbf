"""``egvs figure``: a figure of a run for a paper or a slide, as SVG, PDF with its fonts, or PNG.

The drawing functions of the report draw the figure for the width on paper, with letters of
:data:`egvs.drawing.svg_figures.FONT_SIZE_PT`, in the colours of light pages, and with all colours written on the
shapes.
"""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path

import numpy as np

from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import Tpog, read_tpog
from egvs.core import files, plugins
from egvs.core.errors import InputError, MissingBackendError, unknown_site
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.wording import format_percent
from egvs.drawing import maps
from egvs.drawing import run_figures as figures
from egvs.drawing.maps import Backdrop, SiteViewFigure
from egvs.drawing.run_figures import column_entropy
from egvs.drawing.svg_figures import Bar, Box, FigureStyle, bar_chart, extent
from egvs.export.export import EXPORT_FOLDER, safe_file_name
from egvs.export.finished_run import FinishedRun
from egvs.results.ranking import RankedSite, Ranking
from egvs.stages.site_scans import empty_scans

FIGURES = ("ranking", "map", "tpog", "seen", "missed")
SITE_FIGURES = ("seen", "missed")
FILE_TYPES = ("pdf", "png", "svg")

DOTS_PER_INCH = 600
_FIRST_CHUNK = 33
"""Bytes of a PNG up to the end of its first chunk."""

MIN_WIDTH_MM, MAX_WIDTH_MM = 50.0, 1000.0
MAX_BARS = 40
"""A figure of a ranking shows at most this number of sites."""


def draw_figure(
    folder: str | Path,
    what: str,
    *,
    site: str | None = None,
    kind: str = "pdf",
    width_mm: float = 85.0,
    out: str | Path | None = None,
    progress: ProgressCallback = no_progress,
) -> Path:
    """Draw a figure of a finished run.

    Parameters
    ----------
    folder
        Folder of the run.
    what, kind
        One of :data:`FIGURES`, and one of :data:`FILE_TYPES`.
    site
        The site whose view is drawn, for :data:`SITE_FIGURES`; the best one by default.
    width_mm
        Width on paper.
    out
        The file; ``export/WHAT.KIND`` in the run folder by default.
    progress
        Called after each step.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InputError
        If an option is unknown, an artefact is missing or damaged, or the file cannot be written. Nothing is written
        then.
    """
    folder, out = Path(folder), None if out is None else Path(out)
    _check_arguments(what, site, kind, out)
    run = FinishedRun.open(folder)
    ranking = Ranking.read(run.artefact(RunFolder.scores.name))
    selected = _find_site(ranking, site)
    name = what
    if what in SITE_FIGURES:
        name += f"_{safe_file_name(selected.site)}"
    path = out or folder / EXPORT_FOLDER / f"{name}.{kind}"
    files.check_writable(path)

    svg = _figure_svg(run, what, ranking, selected, FigureStyle.for_print(width_mm))
    progress("drawn", 1, 2)
    with files.atomic_write(path) as partial:
        partial.write_bytes(convert_svg(f"{svg}\n", kind))
    progress("written", 2, 2)
    return path


def _check_arguments(what: str, site: str | None, kind: str, out: Path | None) -> None:
    for option, value, known in (("--what", what, FIGURES), ("--format", kind, FILE_TYPES)):
        if value not in known:
            raise InputError(option, f"expected one of {', '.join(known)}, got {value!r}")
    if site is not None and what not in SITE_FIGURES:
        hint = f"Use --what {' or '.join(SITE_FIGURES)}, or omit --site."
        raise InputError("--site", f"cannot be combined with --what {what}", hint)
    if out is not None and out.suffix != f".{kind}":
        raise InputError("--out", f"expected a name ending in .{kind}, got {str(out)!r}", "Change it, or --format.")
    if kind != "svg":
        plugins.require_libraries(f"a {kind} figure", "figure", "cairosvg")


def _find_site(ranking: Ranking, name: str | None) -> RankedSite:
    if name is None:
        return ranking.best[0]
    for site in ranking.sites:
        if site.site == name:
            return site
    raise unknown_site("--site", name, [site.site for site in ranking.sites], "this run has")


def _figure_svg(run: FinishedRun, what: str, ranking: Ranking, site: RankedSite, style: FigureStyle) -> str:
    if what == "ranking":
        return ranking_chart(ranking, style)
    run.artefact(RunFolder.statics.name)
    tpog = read_tpog(run.artefact(RunFolder.tpog.name))
    backdrop = figures.make_backdrop(run.work, ranking, tpog)
    if what == "map":
        return figures.sites_map(tpog, ranking, backdrop, style)
    if what == "tpog":
        return figures.occupancy_map(tpog, ranking, backdrop, style)
    return _site_view_svg(run, what, site, tpog, extent(tpog.grid, ranking.sites), backdrop, style)


def _site_view_svg(
    run: FinishedRun, what: str, site: RankedSite, tpog: Tpog, box: Box, backdrop: Backdrop, style: FigureStyle
) -> str:
    """Entropy that a site sees or misses."""
    scorer = run.scorer(tpog)
    field, scan = scorer.field, next(empty_scans(run.work, (site.site,)))
    if not len(field.cells):
        raise InputError(f"--what {what}", "no voxel has uncertainty", "Use a run with traffic in the region.")
    crossed = scorer.hits(scan.beams) > 0
    which = crossed.ravel()[field.cells]
    share, verb = site.entropy_seen, "sees"
    if what == "missed":
        which, share, verb = ~which, 1.0 - share, "misses"
    peak = float(column_entropy(field, np.ones(len(which), dtype=np.bool_)).max())
    view = SiteViewFigure(site, crossed, backdrop, box)
    alt = f"From above: the {format_percent(share)} of the entropy {what} by {site.site}."
    label = f"Entropy in the column that {site.site} {verb} (bit)"
    return maps.site_view(tpog.grid, column_entropy(field, which), peak, view, what, alt, style, label)


def ranking_chart(ranking: Ranking, style: FigureStyle) -> str:
    """Return the scores of the sites as bars, SVG text."""
    by = ranking.by
    bars = [
        Bar(site.site, site.score, site.score_se, f"rank {site.rank}, {by.with_noun(site.score)}")
        for site in ranking.sites[:MAX_BARS]
    ]
    number, note = f"{len(ranking.sites)}", ""
    if len(ranking.sites) > MAX_BARS:
        number = f"the best {MAX_BARS} of {len(ranking.sites)}"
        note = f"best {MAX_BARS} of {len(ranking.sites)} sites"
    alt = f"Ranking of {number} sites by {by.noun}; best: {ranking.best[0].site}."
    return bar_chart(bars, by.axis_title, alt, by.axis_factor, style, note)


def convert_svg(svg: str, kind: str) -> bytes:
    """Return a figure as the content of a file that does not depend on the time.

    Parameters
    ----------
    svg
        The figure.
    kind
        One of :data:`FILE_TYPES`.

    Raises
    ------
    MissingBackendError
        If the system library cairo is missing, unless ``kind`` is ``"svg"``.
    """
    if kind == "svg":
        return svg.encode("utf-8")
    try:
        import cairosvg
    except OSError:  # the package is installed, but not the library that it calls
        message = f"a {kind} figure needs the system library cairo (libcairo2); --format svg does not"
        raise MissingBackendError(message) from None
    if kind == "png":
        return _with_resolution(
            cairosvg.svg2png(svg.encode("utf-8"), scale=DOTS_PER_INCH / 96.0, background_color="white")
        )
    pdf: bytes = cairosvg.svg2pdf(svg.encode("utf-8"))
    return re.sub(rb"(/CreationDate \(D:)[0-9]{14}", rb"\g<1>20000101000000", pdf)


def _with_resolution(png: bytes) -> bytes:
    """Add the size on paper to a PNG: a chunk pHYs, in dots per metre, after the first one.

    https://www.w3.org/TR/png-3/#11pHYs
    """
    dots = round(DOTS_PER_INCH / 0.0254)
    content = b"pHYs" + struct.pack(">IIB", dots, dots, 1)
    chunk = struct.pack(">I", len(content) - 4) + content + struct.pack(">I", zlib.crc32(content))
    return png[:_FIRST_CHUNK] + chunk + png[_FIRST_CHUNK:]
