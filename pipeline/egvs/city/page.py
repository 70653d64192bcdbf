"""City.html and its map.

The map of a city's junctions over its streets, coloured by a value of each.

The page of a city run, ``city.html``: where a sensor brings most, junction by junction.

It is a function of the junctions' scores and of the plan alone: no clock, no path, no machine. One file that fetches
nothing; its links lead to the reports of the junctions beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from urllib.parse import quote

import numpy as np

from egvs._version import __version__
from egvs.city.model import NETWORK_FILE, City
from egvs.city.results import RUNS_FOLDER, CityPlan, JunctionResult, gain_label
from egvs.core import files
from egvs.core.errors import Diagnostic
from egvs.report import colours, formatting, maps, page
from egvs.report.colours import STYLE_SHEET
from egvs.report.formatting import ScoreLabel
from egvs.report.svg_figures import Box, ColourBar, CurveStep, MapFrame, sensor_count_chart
from egvs.traffic import network

_WIDTH, _MAX_HEIGHT = 760.0, 720.0
_MAX_NAMES = 12
"""Junctions whose names stand on the map, the first ones; every one tells its own under the pointer."""
_MAX_NUMBERS = 120
"""With more junctions than this, circles have no room for numbers."""
_MIN_EXTENT_M = 300.0
"""What is shown round a single junction, at least."""


@dataclass(frozen=True)
class MapJunction:
    """A junction on the map.

    Attributes
    ----------
    value
        What it is coloured by.
    mark
        What stands in its circle.
    title
        What it tells under the pointer.
    link
        Where a click on it leads; "" for nowhere.
    """

    name: str
    x_m: float
    y_m: float
    value: float
    mark: str
    title: str
    link: str = ""


def junction_map(
    junctions: Sequence[MapJunction], streets: Sequence[str], box: Box, prefix: str, label: str, alt: str
) -> str:
    """Junctions, the first ones above all others, over streets (paths of this box's :func:`map_frame`)."""
    plan = map_frame(box, prefix)
    low, high = min(its.value for its in junctions), max(its.value for its in junctions)
    radius = 9.0 if len(junctions) <= _MAX_NUMBERS else 6.0
    parts = [f'<g class="roads"><path class="street-line" d="{"".join(streets)}"/></g>'] if streets else []
    parts += [_circle(plan, its, low, high, radius, len(junctions) <= _MAX_NUMBERS) for its in reversed(junctions)]
    parts += maps.labels(plan, [(plan.x(its.x_m), plan.y(its.y_m), its.name, radius) for its in junctions[:_MAX_NAMES]])
    return plan.svg(parts, alt, bar=ColourBar(low, high, label, even=True) if high > low else None)


def map_frame(box: Box, prefix: str = "") -> MapFrame:
    """The frame of maps of a city."""
    return MapFrame(box, prefix, width=_WIDTH, tallest=_MAX_HEIGHT, north=True)


def map_box(places_m: Sequence[tuple[float, float]]) -> Box:
    """All junctions (x, y), with a margin."""
    xs, ys = [x for x, _ in places_m], [y for _, y in places_m]
    margin = max(0.08 * max(max(xs) - min(xs), max(ys) - min(ys)), _MIN_EXTENT_M / 2)
    return min(xs) - margin, min(ys) - margin, max(xs) + margin, max(ys) + margin


def street_paths(path: Path | None, box: Box) -> list[str]:
    """The middle lines of a network's roads within a box, those over junctions as well, as paths of its
    :func:`map_frame`;
    none without a network."""
    if path is None:
        return []
    plan, paths = map_frame(box), []
    for edge in network.read_net_xml(path).all_edges:
        if edge.function not in ("", "internal") or not edge.lanes:
            continue
        line = edge.lanes[-1].shape_m[:, :2]
        low, high = line.min(axis=0), line.max(axis=0)
        if low[0] < box[2] and high[0] > box[0] and low[1] < box[3] and high[1] > box[1]:
            points = np.column_stack([plan.x(line[:, 0]), plan.y(line[:, 1])]).round(1).tolist()
            paths.append("M" + "L".join(f"{x:g} {y:g}" for x, y in points))
    return paths


def _circle(plan: MapFrame, junction: MapJunction, low: float, high: float, radius: float, numbered: bool) -> str:
    x, y, step = plan.x(junction.x_m), plan.y(junction.y_m), colours.colour_class(junction.value, low, high)
    tone = "high" if 2 * step > colours.STEPS else "low"
    number = (
        f'<text class="rank {tone}" x="{x:.1f}" y="{y + 3.4:.1f}">{escape(junction.mark)}</text>' if numbered else ""
    )
    shape = f'<circle class="q{step}" cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}"/>{number}'
    drawn = f'<g class="site"><title>{escape(junction.title)}</title>{shape}</g>'
    return f'<a href="{escape(junction.link)}">{drawn}</a>' if junction.link else drawn


PAGE_FILE = "city.html"

CITY_TEMPLATES = Path(__file__).parent / "templates"


def write_page(
    out: Path,
    city: City,
    results: Sequence[JunctionResult],
    warnings: Sequence[Diagnostic],
    plan: CityPlan | None = None,
) -> Path:
    """Write the page; its path."""
    files.write_text(out / PAGE_FILE, render_page(city, results, warnings, plan))
    return out / PAGE_FILE


def render_page(
    city: City, results: Sequence[JunctionResult], warnings: Sequence[Diagnostic], plan: CityPlan | None = None
) -> str:
    """The whole page, HTML text."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=FileSystemLoader([CITY_TEMPLATES, page.TEMPLATES]), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"svg": Markup, "share": formatting.format_percent, "whole": formatting.format_count}
    by = results[0].best.by
    return environment.get_template("city.html.j2").render(
        city=city,
        results=results,
        by=by,
        by_is_egvs=by.name == "egvs",
        gain=gain_label(by.name),
        headline=format_headline(results),
        links={its.junction.id: report_link(its) for its in results},
        maps=page_figures(city, results, plan),
        plan=plan,
        curve=_curve_figure(plan),
        most=max(its.gain for its in results),
        sites=sum(its.sites for its in results),
        warnings=warnings,
        style=Markup(STYLE_SHEET),
        sort=Markup((CITY_TEMPLATES / "sort.js").read_text(encoding="utf-8")),
        version=__version__,
    )


def format_headline(results: Sequence[JunctionResult]) -> str:
    """Where the first sensor brings most, in one sentence."""
    first = results[0]
    if not first.gain > 0:
        return "No pole sees anything of the traffic"
    id_, title = first.junction.id, first.junction.title
    name = f"{id_}, {title}" if title and title != id_ else id_
    if len(results) == 1:
        return f"{name}, the only junction: {first.best.by.sentence(first.score)}"
    equal = sum(its.rank == 1 for its in results)
    if equal > 1:
        return f"{equal} of {len(results)} junctions share the first place"
    return f"Of {len(results)} junctions, a first sensor brings most at {name}"


def report_link(result: JunctionResult) -> str:
    """The report of a junction, seen from the page."""
    return f"{RUNS_FOLDER}/{quote(result.junction.id)}/report.html"


def page_figures(
    city: City, results: Sequence[JunctionResult], plan: CityPlan | None = None
) -> list[tuple[str, str, str]]:
    """Key, title and figure of each map: by what it brings, by what the best pole would see, by the plan."""
    box = map_box([(its.junction.x_m, its.junction.y_m) for its in results])
    streets, by = street_paths(_network_path(city), box), results[0].best.by
    gain = gain_label(by.name)
    values = [("gain", f"by gain: {gain.label}", gain.label, [its.gain for its in results])]
    values.append(
        (
            "seen",
            f"by what the best pole would see: {_visible_share_label(by)}",
            _visible_share_label(by),
            _visible_shares(results),
        )
    )
    if plan is not None:
        counts = [float(plan.by_junction.get(its.junction.id, 0)) for its in results]
        values.append(("plan", "by the sensors of the plan", "sensors", counts))
    return [
        (
            key,
            title,
            junction_map(
                _map_junctions(results, its, by_count=key == "plan"), streets, box, key, label, f"Junctions {title}"
            ),
        )
        for key, title, label, its in values
    ]


def _visible_shares(results: Sequence[JunctionResult]) -> list[float]:
    """What the best pole of each junction would see of it: by the score that ranks where that is a share."""
    return [0.0 if math.isnan(its.score) else its.score if its.best.by.is_share else its.best.entropy_seen
            for its in results]  # fmt: skip


def _visible_share_label(by: ScoreLabel) -> str:
    return by.noun if by.is_share else "the share of the traffic’s uncertainty"


def _curve_figure(plan: CityPlan | None) -> str:
    """How much 1, 2, ... sensors of the city are worth; nothing of a budget."""
    if plan is None or len(plan.curve) < 2:
        return ""
    steps = [
        CurveStep(number, best / plan.together, bound / plan.together)
        for number, (best, bound) in enumerate(plan.curve)
        if number
    ]
    return sensor_count_chart(steps, "How much so many sensors are worth, as a share of all candidates together")


def _map_junctions(results: Sequence[JunctionResult], values: Sequence[float], *, by_count: bool) -> list[MapJunction]:
    return [
        MapJunction(
            its.junction.id, its.junction.x_m, its.junction.y_m, value, f"{value:g}" if by_count else str(its.rank),
            f"{its.rank}. {its.junction.title or its.junction.id}: {its.best.site}, "
            f"{its.best.by.with_noun(its.score)}, "
            f"sees {formatting.format_percent(its.best.entropy_seen)}",
            report_link(its),
        )
        for its, value in zip(results, values, strict=True)
    ]  # fmt: skip


def _network_path(city: City) -> Path | None:
    """The city's network; None where its traffic comes from elsewhere."""
    path = city.folder / (city.traffic.network or NETWORK_FILE)
    return path if path.is_file() and path.name.endswith((".net.xml", ".net.xml.gz")) else None
