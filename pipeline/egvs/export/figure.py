"""Egvs figure: SVG, PDF, PNG for paper.

Makes a figure of the report one that any program draws: a file of its own, with what the style sheet says of light
pages written beside each shape.

Programs that know no style sheets, variables or ``paint-order`` (cairo, Inkscape, what reads SVG into a slide) then
draw what a browser draws. The rules that the style sheet of figures uses are those understood here: classes and names
of elements, one inside another.

https://www.w3.org/TR/SVG11/styling.html, https://www.w3.org/TR/selectors-3/#specificity

A figure of a run for a paper or a slide, by the report's drawing code: SVG, PDF with its fonts in it, or PNG.

A figure is as wide as it is asked to be, and its letters are as large as a paper's: the map is drawn for that width,
not shrunk to it. Colours are those of light pages, viridis, which reads the same for every kind of colour vision.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import Tpog, read_tpog
from egvs.core import files, plugins
from egvs.core.errors import InputError, MissingBackendError
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.export.export import EXPORT_FOLDER, safe_file_name
from egvs.export.finished_run import FinishedRun
from egvs.report import figures, maps
from egvs.report.colours import STYLE_SHEET
from egvs.report.figures import column_entropy
from egvs.report.maps import Backdrop, SiteViewFigure
from egvs.report.ranking import RankedSite, Ranking
from egvs.report.svg_figures import Bar, bar_chart, extent
from egvs.stages.site_scans import empty_scans

FONTS = "DejaVu Sans, Arial, Helvetica, sans-serif"

_SVG = "http://www.w3.org/2000/svg"
_DARK_MEDIA_QUERY, _NIGHT = "@media screen and (prefers-color-scheme: dark)", "night"
_PAGE_PROPERTIES = ("display", "width", "height", "font")
"""What a page says of the place of a figure."""


@dataclass(frozen=True)
class _StyleRule:
    """What holds for elements that match ``path``: from outside to inside, each a class (".site") or a name."""

    path: tuple[str, ...]
    properties: Mapping[str, str]

    @property
    def weight(self) -> tuple[int, int]:
        """How specific it is."""
        classes = sum(part.startswith(".") for part in self.path)
        return classes, len(self.path) - classes


def standalone_svg(figure: str, width_mm: float) -> str:
    """A figure (SVG text of :mod:`egvs.report.drawing`) as a file of its own, so wide on paper."""
    root = ET.fromstring(figure.replace("<svg ", f'<svg xmlns="{_SVG}" ', 1))
    _, _, wide, tall = map(float, root.attrib["viewBox"].split())
    rules = list(_parse_style_sheet(STYLE_SHEET.partition(_DARK_MEDIA_QUERY)[0]))
    ink = next(rule.properties["color"] for rule in rules if "color" in rule.properties)
    _apply_style(root, [], rules, ink)
    root.attrib |= {"width": f"{width_mm:g}mm", "height": f"{width_mm * tall / wide:.3f}mm"}
    root.attrib |= {"font-size": "12", "font-family": FONTS}
    ET.register_namespace("", _SVG)
    return ET.tostring(root, encoding="unicode") + "\n"


def _parse_style_sheet(sheet: str) -> Iterator[_StyleRule]:
    """The rules of a style sheet, variables replaced by what they stand for."""
    variables = dict(re.findall(r"(--[\w-]+):\s*([^;]+);", sheet))
    for selectors, body in re.findall(r"([^{}]+)\{([^{}]*)\}", sheet):
        pairs = (line.split(":", 1) for line in body.split(";") if ":" in line)
        properties = {
            name.strip(): re.sub(r"var\((--[\w-]+)\)", lambda its: variables[its[1]], value.strip())
            for name, value in pairs
            if not name.strip().startswith("--")
        }
        for selector in selectors.split(","):
            yield _StyleRule(tuple(selector.split()), properties)


def _apply_style(element: ET.Element, around: Sequence[ET.Element], rules: Sequence[_StyleRule], ink: str) -> None:
    """Write beside an element, and all within it, what holds for it."""
    inside = [*around, element]
    for name, value in _style(inside, rules).items():
        if name not in _PAGE_PROPERTIES and name not in element.attrib:
            element.set(name, value.replace("currentColor", ink).removesuffix("px"))
    for name in ("fill", "stroke"):
        if element.get(name) == "currentColor":
            element.set(name, ink)
    for child in list(element):
        if _NIGHT in child.get("class", "").split():
            element.remove(child)
            continue
        _apply_style(child, inside, rules, ink)
        if child.attrib.pop("paint-order", "") == "stroke":  # the halo first, then the letters
            letters = _copy_without_stroke(child)
            element.insert(list(element).index(child) + 1, letters)


def _copy_without_stroke(element: ET.Element) -> ET.Element:
    copy = ET.Element(element.tag, {k: v for k, v in element.attrib.items() if not k.startswith("stroke")})
    copy.text = element.text
    return copy


def _style(path: Sequence[ET.Element], rules: Sequence[_StyleRule]) -> dict[str, str]:
    """What holds for the last element of a path from the root; of two rules the more specific, or the later."""
    found: dict[str, str] = {}
    for rule in sorted((rule for rule in rules if _matches(rule.path, path)), key=lambda rule: rule.weight):
        found |= rule.properties
    return found


def _matches(selector: Sequence[str], path: Sequence[ET.Element]) -> bool:
    *outer, last = selector
    if not _matches_part(last, path[-1]):
        return False
    waiting = list(outer)
    for element in path[-2::-1]:
        if waiting and _matches_part(waiting[-1], element):
            waiting.pop()
    return not waiting


def _matches_part(part: str, element: ET.Element) -> bool:
    if part.startswith("."):
        return part[1:] in element.get("class", "").split()
    return element.tag == f"{{{_SVG}}}{part}"


FIGURES = ("ranking", "map", "tpog", "seen", "missed")
SITE_FIGURES = ("seen", "missed")
FILE_TYPES = ("pdf", "png", "svg")

DOTS_PER_INCH = 600
_FIRST_CHUNK = 33
"""Bytes of a PNG to the end of its first chunk."""
FONT_SIZE_PT = 7.0
"""How large letters are on paper; 12 units of a figure."""

MIN_WIDTH_MM, MAX_WIDTH_MM = 50.0, 1000.0
MAX_BARS = 40
"""Of a ranking the first ones are drawn."""


def draw_figure(
    folder: Path,
    what: str,
    *,
    site: str | None = None,
    kind: str = "pdf",
    width_mm: float = 85.0,
    out: Path | None = None,
    progress: ProgressCallback = no_progress,
) -> Path:
    """Draw a figure of a finished run; its path.

    Parameters
    ----------
    what, kind
        One of :data:`FIGURES`, and of :data:`FILE_TYPES`.
    site
        Of :data:`SITE_FIGURES`: whose view is drawn; the best one's by default.
    out
        The file; in the run's folder ``export/WHAT.KIND`` by default.

    Raises
    ------
    InputError
        Names what is unknown, missing, damaged, or cannot be written; nothing is written then.
    """
    _check_arguments(what, site, kind, out)
    run = FinishedRun.open(folder)
    ranking = Ranking.read(run.artefact(RunFolder.scores.name))
    chosen = _find_site(ranking, site)
    name = f"{what}_{safe_file_name(chosen.site)}" if what in SITE_FIGURES else what
    path = out or folder / EXPORT_FOLDER / f"{name}.{kind}"
    files.check_writable(path)
    units = width_mm / 25.4 * 72.0 * 12.0 / FONT_SIZE_PT
    svg = standalone_svg(_figure_svg(run, what, ranking, chosen, units), width_mm)
    progress("drawn", 1, 2)
    with files.atomic_write(path) as partial:
        partial.write_bytes(_convert_svg(svg, kind))
    progress("written", 2, 2)
    return path


def _check_arguments(what: str, site: str | None, kind: str, out: Path | None) -> None:
    for option, value, known in (("--what", what, FIGURES), ("--format", kind, FILE_TYPES)):
        if value not in known:
            raise InputError(option, repr(value), f"one of {', '.join(known)}")
    if site is not None and what not in SITE_FIGURES:
        raise InputError("--site", f"with --what {what}", f"--what {' or '.join(SITE_FIGURES)}")
    if out is not None and out.suffix != f".{kind}":
        raise InputError("--out", repr(str(out)), f"a file that ends in .{kind} for --format {kind}")
    if kind != "svg":
        plugins.require_libraries(f"a figure as {kind}", "figure", "cairosvg")


def _find_site(ranking: Ranking, name: str | None) -> RankedSite:
    if name is None:
        return ranking.best[0]
    found = next((its for its in ranking.sites if its.site == name), None)
    if found is None:
        some = ", ".join(its.site for its in ranking.sites[:10]) + (", ..." if len(ranking.sites) > 10 else "")
        raise InputError("--site", f"{name!r} is no site of this run", f"one of {some}")
    return found


def _figure_svg(run: FinishedRun, what: str, ranking: Ranking, site: RankedSite, units: float) -> str:
    """SVG text, so many units wide."""
    if what == "ranking":
        return ranking_chart(ranking, units)
    run.artefact(RunFolder.statics.name)
    tpog = read_tpog(run.artefact(RunFolder.tpog.name))
    backdrop = figures.make_backdrop(run.work, ranking, tpog)
    if what == "map":
        return figures.sites_map(tpog, ranking, backdrop, units)
    if what == "tpog":
        return figures.occupancy_map(tpog, ranking, backdrop, units)
    return _site_map_svg(run, what, site, tpog, ranking, backdrop, units)


def _site_map_svg(
    run: FinishedRun, what: str, site: RankedSite, tpog: Tpog, ranking: Ranking, backdrop: Backdrop, units: float
) -> str:
    """What a site sees or misses of the entropy, SVG text."""
    scorer = run.scorer(tpog)
    field, scan = scorer.field, next(empty_scans(run.work, (site.site,)))
    if not len(field.cells):
        raise InputError(f"--what {what}", "nothing is uncertain in this run", "a run with traffic in its region")
    crossed = scorer.hits(scan.beams) > 0
    here = crossed.ravel()[field.cells]
    peak = float(column_entropy(field, np.ones(len(here), dtype=np.bool_)).max())
    view = SiteViewFigure(site, crossed, backdrop, extent(tpog.grid, ranking.sites))
    share = site.entropy_seen if what == "seen" else 1.0 - site.entropy_seen
    alt = f"From above: the {share:.1%} of the entropy {what} by {site.site}."
    values = column_entropy(field, here if what == "seen" else ~here)
    label = f"Entropy in the column that {site.site} {'sees' if what == 'seen' else 'misses'} (bit)"
    return maps.site_view(tpog.grid, values, peak, view, what, alt, units, label)


def ranking_chart(ranking: Ranking, units: float) -> str:
    """The sites' scores as bars, SVG text."""
    by, shown = ranking.by, ranking.sites[:MAX_BARS]
    bars = [Bar(its.site, its.score, its.score_se, f"rank {its.rank}, {by.with_noun(its.score)}") for its in shown]
    label = f"{by.label} (%)" if by.is_share else by.label
    alt = f"Ranking of {len(ranking.sites)} sites by {by.noun}; best: {ranking.best[0].site}."
    return bar_chart(bars, label, alt, units, 100.0 if by.is_share else 1.0)


def _convert_svg(svg: str, kind: str) -> bytes:
    """A figure as a file's content; it depends on no clock."""
    if kind == "svg":
        return svg.encode("utf-8")
    try:
        import cairosvg
    except OSError:  # the package is there, and the library that it calls is not
        told = f"a figure as {kind} needs the library cairo of the system (libcairo2); --format svg needs none"
        raise MissingBackendError(told) from None
    if kind == "png":
        return _with_resolution(
            cairosvg.svg2png(svg.encode("utf-8"), scale=DOTS_PER_INCH / 96.0, background_color="white")
        )
    pdf: bytes = cairosvg.svg2pdf(svg.encode("utf-8"))
    return re.sub(rb"(/CreationDate \(D:)[0-9]{14}", rb"\g<1>20000101000000", pdf)


def _with_resolution(png: bytes) -> bytes:
    """A PNG that says how large it is on paper: a chunk pHYs, in dots per metre, behind the first one.

    https://www.w3.org/TR/png-3/#11pHYs
    """
    dots = round(DOTS_PER_INCH / 0.0254)
    content = b"pHYs" + struct.pack(">IIB", dots, dots, 1)
    chunk = struct.pack(">I", len(content) - 4) + content + struct.pack(">I", zlib.crc32(content))
    return png[:_FIRST_CHUNK] + chunk + png[_FIRST_CHUNK:]
