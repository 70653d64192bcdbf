"""The page of a city run: its content, and names with markup."""

from __future__ import annotations

import math
import re
from pathlib import Path

from egvs.city import page
from egvs.city.model import City, CityJunction
from egvs.city.results import JunctionResult
from egvs.core.errors import Diagnostic
from egvs.report.ranking import RankedSite
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
    assert "33.3%" in html
    assert "<b>where</b>: problem. <small>hint</small>" in html
    assert "© the mappers" in html
    assert html.count('class="plan"') == 2  # by gain, and by the share that is seen


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
