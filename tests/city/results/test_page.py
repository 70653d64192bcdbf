"""The page of a city: what it says, and that names cannot break it."""

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

HOSTILE = '<script>alert("x")</script> & "Sons"'


def result(name: str, rank: int, egvs: float, title: str = "") -> JunctionResult:
    """A junction with one site."""
    best = RankedSite("pole", 0.0, 0.0, 3.0, egvs, 1, "pole", 0.0, 0.0, 0.0, "VLP-16", 1e3, 10, 5, 0.25)
    return JunctionResult(CityJunction(name, title, 10.0 * rank, 5.0, 50.0, 9.0, True), 3, best, 4.0, rank)


def city(*results: JunctionResult) -> City:
    """A city without a network."""
    traffic = TrafficConfig.model_construct(network=None)
    return City(Path("/nowhere"), "town", 1, traffic, tuple(its.junction for its in results), "© the mappers")


def test_it_says_where_the_first_sensor_brings_most() -> None:
    some = (result("a", 1, 90.0, "Main Street"), result("b", 2, 30.0))
    html = page.render_page(city(*some), some, [Diagnostic("rule", "place", "found", "cure")])
    assert "Of 2 junctions, a first sensor brings most at a, Main Street" in html
    assert "33.3%" in html
    assert "<b>place</b>: found <small>cure</small>" in html
    assert "© the mappers" in html
    assert html.count('class="plan"') == 2  # by gain, and by what is seen


def test_names_are_text() -> None:
    some = (result("a", 1, 90.0, HOSTILE), result("b c", 2, 30.0))
    html = page.render_page(city(*some), some, ())
    assert "<script>alert" not in html
    assert 'href="junctions/b%20c/report.html"' in html


def test_a_junction_without_a_score_comes_last_and_breaks_nothing() -> None:
    some = (result("a", 1, 90.0), result("b", 2, math.nan))
    assert some[1].gain == 0.0
    assert not re.search(r"\bnan\b", page.render_page(city(*some), some, ()))
    assert page.format_headline([result("a", 1, 0.0)]) == "No pole sees anything of the traffic"
    assert page.format_headline([result("a", 1, 5.0), result("b", 1, 5.0)]) == "2 of 2 junctions share the first place"
    assert page.format_headline([result("a", 1, 5.0)]) == "a, the only junction: scores 5 bit"
