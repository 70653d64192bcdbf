"""The page of a city run: its content, and names with markup."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

from egvs.core.errors import Diagnostic
from egvs.extensions.city import page
from egvs.extensions.city.model import City, CityJunction
from egvs.extensions.city.results import BudgetPoint, CityPlan, JunctionResult
from egvs.results.ranking import RankedSite, ScoreValue
from egvs.scenario.traffic_config import TrafficConfig

MARKUP = '<script>alert("x")</script> & "Sons"'


def make_result(name: str, rank: int, egvs: float, title: str = "") -> JunctionResult:
    """Return the result of a junction with one site."""
    best = RankedSite("pole", 0.0, 0.0, 3.0, egvs, 1, "pole", 0.0, 0.0, 0.0, "VLP-16", 1e3, 10, 5, 0.25)
    return JunctionResult(CityJunction(name, title, 10.0 * rank, 5.0, 50.0, 9.0, True), 3, best, 4.0, rank)


def make_city(*results: JunctionResult) -> City:
    """Return a city without a network."""
    traffic = TrafficConfig.model_construct(network=None)
    junctions = tuple(result.junction for result in results)
    return City(Path("/nowhere"), "town", 1, traffic, junctions, "© the mappers")


def test_shows_best_junction_warnings_and_attribution() -> None:
    results = (make_result("a", 1, 90.0, "Main Street"), make_result("b", 2, 30.0))
    html = page.render_page(make_city(*results), results, [Diagnostic("rule", "where", "problem", "hint")])
    assert "Of 2 junctions, a first sensor has the largest gain at a, Main Street" in html
    assert "33.3\u00a0%" in html
    assert "<b>where</b>: problem. <small>hint</small>" in html
    assert "© the mappers" in html
    assert html.count('class="plan"') == 2  # by gain, and by the share that is seen
    for figure in re.findall(r"<svg.*?</svg>", html, re.DOTALL):
        assert ('role="group"' in figure) == ("<a " in figure), "an image hides its links from screen readers"


def test_shows_what_people_notice_where_it_is_known_for_all_junctions() -> None:
    known, other = make_result("a", 1, 90.0), make_result("b", 2, 30.0)
    shares = {"others": (ScoreValue("noticed", 0.9, 0.02),), "noticed_low": 0.9, "noticed_high": 0.9}
    known = replace(known, best=replace(known.best, **shares))
    wide = replace(other, best=replace(other.best, **shares | {"noticed_low": 0.61}))
    html = page.render_page(make_city(known, wide), (known, wide), [])
    assert '<td class="n" data-label="Noticed" data-value="0.9">90 %</td>' in html.replace("\u00a0", " ")
    assert '<td class="n" data-label="Noticed" data-value="0.9">60 to 90 %</td>' in html.replace("\u00a0", " ")
    assert "Noticed" not in page.render_page(make_city(known, other), (known, other), [])


def make_plan(requested: str, phases: tuple[int, ...] = (), se: float = 2.0) -> CityPlan:
    """Return a plan without sensors and with a curve of three points."""
    curve = tuple(BudgetPoint(n, n, 5.0 * n, 30.0 * n, se * n, 31.0 * n, 29.0 * n, se * n) for n in range(3))
    has_errors = not math.isnan(se)
    return CityPlan((), "egvs", {requested: 2.0}, 60.0, 62.0, 90.0, 9, 2, curve, phases, "the <blocks>", has_errors)


def test_shows_curve_with_errors_and_phases() -> None:
    results = (make_result("a", 1, 90.0), make_result("b", 2, 30.0))
    html = page.render_page(make_city(*results), results, (), make_plan("count", (1, 2)))
    assert "Standard errors come from the &lt;blocks&gt;." in html
    assert 'class="curve-band"' in html and 'class="curve-installed"' in html
    assert "2 sensors: 60 ± 4, at most 62" in html
    assert html.count('class="curve-phase"') == 2
    assert ">3.33\u00a0%<" in html  # 29 instead of 30


def test_curve_without_errors_says_why() -> None:
    results = (make_result("a", 1, 90.0), make_result("b", 2, 30.0))
    html = page.render_page(make_city(*results), results, (), make_plan("budget", (), math.nan))
    assert "There are no standard errors: the &lt;blocks&gt;." in html
    assert 'class="curve-band"' not in html and 'class="curve-installed"' not in html
    assert "cost 10, 2 sensors: 60, at most 62" in html
    assert not re.search(r"\bnan\b", html)


def test_escapes_names() -> None:
    results = (make_result("a", 1, 90.0, MARKUP), make_result("b c", 2, 30.0))
    html = page.render_page(make_city(*results), results, ())
    assert "<script>alert" not in html
    assert 'href="junctions/b%20c/report.html"' in html


def test_shows_junction_without_score() -> None:
    results = (make_result("a", 1, 90.0), make_result("b", 2, math.nan))
    assert results[1].gain == 0.0
    assert not re.search(r"\bnan\b", page.render_page(make_city(*results), results, ()))


def test_headline_for_no_gain_ties_and_single_junction() -> None:
    assert page.format_headline([make_result("a", 1, 0.0)]) == "No site sees any traffic"
    tie = [make_result("a", 1, 5.0), make_result("b", 1, 5.0)]
    assert page.format_headline(tie) == "2 of 2 junctions share first place"
    assert page.format_headline([make_result("a", 1, 5.0)]) == "a, the only junction: scores 5 bit"
