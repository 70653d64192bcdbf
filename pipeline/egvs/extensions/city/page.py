"""``city.html``: the page of a city run, with maps of its junctions.

The page depends on the scores of the junctions and on the plan alone, not on a clock, a path or a machine. It is one
file that loads nothing; its links lead to the reports of the junctions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import numpy as np

from egvs.core import files
from egvs.core.errors import Diagnostic
from egvs.core.wording import format_percent
from egvs.drawing import colours, maps, pages
from egvs.drawing.svg_figures import Box, ColourBar, MapFrame
from egvs.extensions.city.budget_figure import budget_chart, curve_rows
from egvs.extensions.city.model import NETWORK_FILE, City
from egvs.extensions.city.results import (
    RUNS_FOLDER,
    CityPlan,
    JunctionResult,
    counts_vehicles,
    gain_label,
    has_noticed,
)
from egvs.results.labels import SCORE_LABELS
from egvs.scenario.score_config import NOTICED
from egvs.traffic import network

PAGE_FILE = "city.html"
CITY_TEMPLATES = Path(__file__).parent / "templates"

_WIDTH, _MAX_HEIGHT = 760.0, 720.0
_MAX_NAMES = 12
"""Number of junctions whose names are on the map, the best ones first."""

_MAX_NUMBERS = 120
"""With more junctions than this, the circles have no numbers."""

_MIN_EXTENT_M = 300.0
_MARGIN_SHARE = 0.08
"""A map shows at least this extent, and a margin of this share."""


@dataclass(frozen=True)
class MapJunction:
    """A junction on the map.

    Attributes
    ----------
    name, x_m, y_m
        Its name and position.
    value
        The value that its colour shows.
    number
        The text in its circle.
    title
        Its tooltip.
    link
        Target of a click; "" for none.
    """

    name: str
    x_m: float
    y_m: float
    value: float
    number: str
    title: str
    link: str = ""


class MapFigure(NamedTuple):
    """A map of the page: its key in the page's script, its title, and its SVG text."""

    key: str
    title: str
    svg: str


def junction_map(
    junctions: Sequence[MapJunction], streets: Sequence[str], box: Box, prefix: str, label: str, alt: str
) -> str:
    """Draw junctions over streets, coloured by value.

    Parameters
    ----------
    junctions
        The first ones are drawn above all others.
    streets
        From :func:`street_paths` of the same box.
    box
        The area shown, in world metres.
    prefix
        Prefix of ids in the SVG.
    label, alt
        Title of the colour bar, and text for screen readers.
    """
    frame = map_frame(box, prefix)
    values = [junction.value for junction in junctions]
    low, high = min(values), max(values)
    has_numbers = len(junctions) <= _MAX_NUMBERS
    radius = 9.0 if has_numbers else 6.0

    parts = []
    if streets:
        parts.append(f'<g class="roads"><path class="street-line" d="{"".join(streets)}"/></g>')
    for junction in reversed(junctions):
        colour = colours.colour_class(junction.value, low, high)
        parts.append(_circle(frame, junction, colour, radius, has_numbers))
    named = junctions[:_MAX_NAMES]
    parts += maps.labels(frame, [(frame.x(j.x_m), frame.y(j.y_m), j.name, radius) for j in named])
    bar = ColourBar(low, high, label, even=True) if high > low else None
    # an image cannot have links in it
    return frame.svg(parts, alt, bar=bar).replace('role="img"', 'role="group"', 1)


def map_frame(box: Box, prefix: str = "") -> MapFrame:
    """Return the frame of maps of a city."""
    return MapFrame(box, prefix, width=_WIDTH, tallest=_MAX_HEIGHT, north=True)


def map_box(positions_m: Sequence[tuple[float, float]]) -> Box:
    """Return the box around positions (x, y), with a margin."""
    xs, ys = zip(*positions_m, strict=True)
    extent_m = max(max(xs) - min(xs), max(ys) - min(ys))
    margin_m = max(_MARGIN_SHARE * extent_m, _MIN_EXTENT_M / 2)
    return min(xs) - margin_m, min(ys) - margin_m, max(xs) + margin_m, max(ys) + margin_m


def street_paths(path: Path | None, box: Box) -> list[str]:
    """Return the streets of a network within a box as SVG paths in its :func:`map_frame`; none without a network."""
    if path is None:
        return []
    frame, paths = map_frame(box), []
    for edge in network.read_net_xml(path).all_edges:
        if edge.function not in ("", "internal") or not edge.lanes:
            continue
        line = edge.lanes[-1].shape_m[:, :2]  # the lane next to the middle of the road
        low, high = line.min(axis=0), line.max(axis=0)
        if low[0] < box[2] and high[0] > box[0] and low[1] < box[3] and high[1] > box[1]:
            points = np.column_stack([frame.x(line[:, 0]), frame.y(line[:, 1])]).round(1).tolist()
            paths.append("M" + "L".join(f"{x:g} {y:g}" for x, y in points))
    return paths


def _circle(frame: MapFrame, junction: MapJunction, colour: int, radius: float, has_number: bool) -> str:
    x, y = frame.x(junction.x_m), frame.y(junction.y_m)
    circle = f'<circle class="q{colour}" cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}"/>'
    if has_number:
        tone = "high" if 2 * colour > colours.STEPS else "low"
        circle += f'<text class="rank {tone}" x="{x:.1f}" y="{y + 3.4:.1f}">{escape(junction.number)}</text>'
    group = f'<g class="site"><title>{escape(junction.title)}</title>{circle}</g>'
    if not junction.link:
        return group
    return f'<a href="{escape(junction.link)}">{group}</a>'


def write_page(
    out: Path,
    city: City,
    results: Sequence[JunctionResult],
    warnings: Sequence[Diagnostic],
    plan: CityPlan | None = None,
) -> Path:
    """Write the page into the folder of a city run; return its path. Parameters as in :func:`render_page`."""
    files.write_text(out / PAGE_FILE, render_page(city, results, warnings, plan))
    return out / PAGE_FILE


def render_page(
    city: City, results: Sequence[JunctionResult], warnings: Sequence[Diagnostic], plan: CityPlan | None = None
) -> str:
    """Return the page, HTML text.

    Parameters
    ----------
    city
        The city.
    results
        Its junctions, the best first.
    warnings
        What to know before trusting the results.
    plan
        The plan of the city, if there is one.
    """
    score = results[0].best.by
    return pages.render(
        pages.page_environment(CITY_TEMPLATES),
        "city.html.j2",
        city=city,
        results=results,
        score=score,
        is_egvs=score.name == "egvs",
        noticed=SCORE_LABELS[NOTICED] if has_noticed(results) else None,
        gain=gain_label(score.name),
        headline=format_headline(results),
        links={result.junction.id: report_link(result) for result in results},
        maps=page_maps(city, results, plan),
        plan=plan,
        curve="" if plan is None else budget_chart(plan),
        curve_rows=() if plan is None else curve_rows(plan),
        counts_vehicles=counts_vehicles(score.name),
        vehicles=sum(result.vehicles for result in results),
        max_gain=max(result.gain for result in results),
        sites=sum(result.sites for result in results),
        warnings=warnings,
        script=(CITY_TEMPLATES / "sort.js").read_text(encoding="utf-8"),
    )


def format_headline(results: Sequence[JunctionResult]) -> str:
    """Say in one sentence where the first sensor has the largest gain."""
    first = results[0]
    if first.gain <= 0:
        return "No site sees any traffic"
    name = first.junction.id
    if first.junction.title not in ("", name):
        name += f", {first.junction.title}"
    if len(results) == 1:
        return f"{name}, the only junction: {first.best.by.sentence(first.score)}"
    n_best = sum(result.rank == 1 for result in results)
    if n_best > 1:
        return f"{n_best} of {len(results)} junctions share first place"
    return f"Of {len(results)} junctions, a first sensor has the largest gain at {name}"


def report_link(result: JunctionResult) -> str:
    """Return the link from the page to the report of a junction."""
    return f"{RUNS_FOLDER}/{quote(result.junction.id)}/report.html"


def page_maps(city: City, results: Sequence[JunctionResult], plan: CityPlan | None = None) -> list[MapFigure]:
    """Return the maps of the page: by gain, by the share that the best site sees, and by the sensors of the plan."""
    box = map_box([(result.junction.x_m, result.junction.y_m) for result in results])
    streets, score = street_paths(_network_path(city), box), results[0].best.by
    ranks = [str(result.rank) for result in results]

    def draw(key: str, title: str, label: str, values: Sequence[float], numbers: Sequence[str]) -> MapFigure:
        junctions = [_map_junction(*row) for row in zip(results, values, numbers, strict=True)]
        return MapFigure(key, title, junction_map(junctions, streets, box, key, label, f"Junctions {title}"))

    gain = gain_label(score.name).label
    figures = [draw("gain", f"by gain: {gain}", gain, [result.gain for result in results], ranks)]
    label = score.noun if score.is_share else "share of the traffic’s uncertainty seen"
    percent = [100.0 * _visible_share(result) for result in results]
    figures.append(draw("seen", f"by the best site of each junction: {label}", f"{label} (%)", percent, ranks))
    if plan is not None:
        counts = [float(plan.by_junction.get(result.junction.id, 0)) for result in results]
        numbers = [f"{count:g}" for count in counts]
        figures.append(draw("plan", "by number of planned sensors", "sensors", counts, numbers))
    return figures


def _visible_share(result: JunctionResult) -> float:
    """Return the score of the best site if it is a share, otherwise the share of entropy that it sees."""
    if math.isnan(result.score):
        return 0.0
    return result.score if result.best.by.is_share else result.best.entropy_seen


def _map_junction(result: JunctionResult, value: float, number: str) -> MapJunction:
    junction, best = result.junction, result.best
    title = (
        f"{result.rank}. {junction.title or junction.id}: {best.site}, {best.by.with_noun(result.score)}, "
        f"sees {format_percent(best.entropy_seen)}"
    )
    return MapJunction(junction.id, junction.x_m, junction.y_m, value, number, title, report_link(result))


def _network_path(city: City) -> Path | None:
    """Return the city's network; None if its traffic comes from a file."""
    path = city.folder / (city.traffic.network or NETWORK_FILE)
    if path.is_file() and path.name.endswith((".net.xml", ".net.xml.gz")):
        return path
    return None
