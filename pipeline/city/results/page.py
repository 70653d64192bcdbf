"""The page of a city run, ``city.html``: where a sensor brings most, junction by junction.

It is a function of the junctions' scores and of the plan alone: no clock, no path, no machine. One file that fetches
nothing; its links lead to the reports of the junctions beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from pipeline.city.model import NETWORK, City
from pipeline.city.results import map as drawing
from pipeline.city.results.junctions import RUNS, JunctionResult
from pipeline.city.results.map import MapJunction
from pipeline.city.results.plan import CityPlan
from pipeline.city.results.words import gain_words
from pipeline.core import files
from pipeline.core.findings import Finding
from pipeline.core.version import __version__
from pipeline.report import page as report
from pipeline.report import wording
from pipeline.report.drawing.colours import STYLE_SHEET
from pipeline.report.drawing.placement import CurveStep, curve
from pipeline.report.score_words import ScoreWords

PAGE = "city.html"

TEMPLATES = Path(__file__).parent / "templates"


def write(
    out: Path,
    city: City,
    results: Sequence[JunctionResult],
    warnings: Sequence[Finding],
    plan: CityPlan | None = None,
) -> Path:
    """Write the page; its path."""
    files.write_text(out / PAGE, page(city, results, warnings, plan))
    return out / PAGE


def page(
    city: City, results: Sequence[JunctionResult], warnings: Sequence[Finding], plan: CityPlan | None = None
) -> str:
    """The whole page, HTML text."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=FileSystemLoader([TEMPLATES, report.TEMPLATES]), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"svg": Markup, "share": wording.share, "whole": wording.whole}
    by = results[0].best.by
    return environment.get_template("city.html.j2").render(
        city=city,
        results=results,
        by=by,
        by_is_egvs=by.name == "egvs",
        gain=gain_words(by.name),
        headline=headline(results),
        links={its.junction.id: link(its) for its in results},
        maps=figures(city, results, plan),
        plan=plan,
        curve=_curve(plan),
        most=max(its.gain for its in results),
        sites=sum(its.sites for its in results),
        warnings=warnings,
        style=Markup(STYLE_SHEET),
        sort=Markup((TEMPLATES / "sort.js").read_text(encoding="utf-8")),
        version=__version__,
    )


def headline(results: Sequence[JunctionResult]) -> str:
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


def link(its: JunctionResult) -> str:
    """The report of a junction, seen from the page."""
    return f"{RUNS}/{quote(its.junction.id)}/report.html"


def figures(city: City, results: Sequence[JunctionResult], plan: CityPlan | None = None) -> list[tuple[str, str, str]]:
    """Key, title and figure of each map: by what it brings, by what the best pole would see, by the plan."""
    box = drawing.box_of([(its.junction.x_m, its.junction.y_m) for its in results])
    streets, by = drawing.street_paths(_network(city), box), results[0].best.by
    gain = gain_words(by.name)
    values = [("gain", f"by gain: {gain.label}", gain.label, [its.gain for its in results])]
    values.append(("seen", f"by what the best pole would see: {_seen_label(by)}", _seen_label(by), _seen(results)))
    if plan is not None:
        counts = [float(plan.by_junction.get(its.junction.id, 0)) for its in results]
        values.append(("plan", "by the sensors of the plan", "sensors", counts))
    return [
        (
            key,
            title,
            drawing.junction_map(
                _marks(results, its, by_count=key == "plan"), streets, box, key, label, f"Junctions {title}"
            ),
        )
        for key, title, label, its in values
    ]


def _seen(results: Sequence[JunctionResult]) -> list[float]:
    """What the best pole of each junction would see of it: by the score that ranks where that is a share."""
    return [0.0 if math.isnan(its.score) else its.score if its.best.by.is_share else its.best.entropy_seen
            for its in results]  # fmt: skip


def _seen_label(by: ScoreWords) -> str:
    return by.noun if by.is_share else "the share of the traffic’s uncertainty"


def _curve(plan: CityPlan | None) -> str:
    """How much 1, 2, ... sensors of the city are worth; nothing of a budget."""
    if plan is None or len(plan.curve) < 2:
        return ""
    steps = [
        CurveStep(number, best / plan.together, bound / plan.together)
        for number, (best, bound) in enumerate(plan.curve)
        if number
    ]
    return curve(steps, "How much so many sensors are worth, as a share of all candidates together")


def _marks(results: Sequence[JunctionResult], values: Sequence[float], *, by_count: bool) -> list[MapJunction]:
    return [
        MapJunction(
            its.junction.id, its.junction.x_m, its.junction.y_m, value, f"{value:g}" if by_count else str(its.rank),
            f"{its.rank}. {its.junction.title or its.junction.id}: {its.best.site}, {its.best.by.told(its.score)}, "
            f"sees {wording.share(its.best.entropy_seen)}",
            link(its),
        )
        for its, value in zip(results, values, strict=True)
    ]  # fmt: skip


def _network(city: City) -> Path | None:
    """The city's network; None where its traffic comes from elsewhere."""
    path = city.folder / (city.traffic.network or NETWORK)
    return path if path.is_file() and path.name.endswith((".net.xml", ".net.xml.gz")) else None
