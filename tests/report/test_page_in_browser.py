"""The report with all its sections in a browser: no width scrolls the page sideways, wide tables scroll by themselves.

The run has long names, periods, columns of the user, a plan, a validation and a study of the accuracy.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from egvs.cli.commands import GROUP
from egvs.core import plugins
from tests.accessibility import violations
from tests.chromium import needs_chromium, open_chromium
from tests.conftest import write_mini
from tests.installed import needs
from tests.processes import run_egvs

pytestmark = [
    pytest.mark.slow,
    pytest.mark.system,
    needs_chromium,
]

SITES = """\
site,x_m,y_m,z_m,yaw_deg,owner of the pole,note
corner_of_a_street_with_a_long_name@3m-10deg,10,12,3,-130,the municipal utilities,a_word_of_33_letters_without_break
corner_of_a_street_with_a_long_name@5m-10deg,10,12,5,-130,the municipal utilities,
pole_b,30.5,-12,3,120,,behind the shelter
"""

PERIODS = "traffic.periods=[{name='morning_peak', length_s=12}, {name='evening_peak', begin_s=12, length_s=8}]"

SECTIONS = (
    "Where the sites are", "Ranking", "What the score means", "The best site on each pole",
    "Your columns from the sites file", "By period", "Where the traffic is", "What a site sees and misses",
    "Which sites together?", "Does the score predict detection?", "What a right decision costs in computing time",
    "Input data and computing time", "What is not modelled",
)  # fmt: skip

OUTSIDE = """() => [...document.querySelectorAll("body *")]
    .filter(e => !e.closest(".scroll, svg, select") && e.getBoundingClientRect().right > innerWidth + 1)
    .map(e => `${e.tagName} ${e.className}: ${e.textContent.slice(0, 40)}`)"""

TEXTS_THAT_OVERLAP = """selector => {
    const boxes = [...document.querySelector(selector).querySelectorAll("text.label")]
        .filter(e => getComputedStyle(e).display !== "none")
        .map(e => ({text: e.textContent, box: e.getBoundingClientRect()}));
    const apart = (a, b) => a.right <= b.left || b.right <= a.left || a.bottom <= b.top || b.bottom <= a.top;
    return boxes.flatMap((a, i) => boxes.slice(i + 1).filter(b => !apart(a.box, b.box)).map(b => [a.text, b.text]));
}"""


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a run with every section."""
    folder = tmp_path_factory.mktemp("all_sections")
    scenario, out = write_mini(folder / "mini"), folder / "run"
    (scenario / "sites.csv").write_text(SITES)
    verbs = [("run",), ("place", "--count", "2"), ("accuracy", "--budget", "0.001s")]
    if "validation" in plugins.plugin_names(GROUP):
        verbs.append(("validate", "--frames", "10", "--spacing", "0.5", "--detector", "points", "--jobs", "1"))
    for verb in verbs:
        done = run_egvs(verb[0], scenario, "--out", out, "--set", PERIODS, *verb[1:])
        assert done.returncode == 0, done.stderr
    return out / "report.html"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with open_chromium() as opened:
        yield opened


@pytest.fixture(params=[(390, "light"), (390, "dark"), (768, "light"), (1280, "light")], ids=str)
def page(report: Path, browser: Any, request: pytest.FixtureRequest) -> Iterator[Any]:
    """The report in a window of this width."""
    width, scheme = request.param
    opened = browser.new_page(color_scheme=scheme, viewport={"width": width, "height": 900})
    opened.goto(report.as_uri())
    yield opened
    opened.close()


@needs("validation")
def test_report_has_every_section_with_the_map_before_the_tables(page: Any) -> None:
    assert page.locator("h2").all_inner_texts() == ["Before you trust this ranking", *SECTIONS]
    assert page.locator("details:not([open]) > summary > h2").count() >= 4  # what only experts read is folded
    tops = page.evaluate("['svg', 'table'].map(e => document.querySelector(e).getBoundingClientRect().top)")
    assert tops[0] < tops[1]


@pytest.mark.parametrize(("width", "height"), [(1280, 900), (390, 844)])
def test_the_first_screen_is_the_answer_and_a_map(report: Path, browser: Any, width: int, height: int) -> None:
    page = browser.new_page(viewport={"width": width, "height": height})
    page.goto(report.as_uri())
    answer = page.locator("#answer svg").bounding_box()
    assert answer["y"] + answer["height"] <= height
    assert answer["width"] > 0.8 * min(width, 640)
    assert page.locator("h1").bounding_box()["y"] < answer["y"] + answer["height"]
    page.close()


def test_page_violates_no_rule_of_accessibility(page: Any) -> None:
    assert violations(page) == []
    page.evaluate("document.querySelectorAll('details').forEach(each => each.open = true)")
    assert violations(page) == []


def test_rules_of_accessibility_find_a_picture_without_text(browser: Any) -> None:
    page = browser.new_page()
    page.set_content('<html lang="en"><title>t</title><main><h1>A picture</h1><img src="data:,"></main></html>')
    assert [rule.partition(":")[0] for rule in violations(page)] == ["image-alt"]
    page.close()


def test_page_does_not_scroll_sideways(page: Any) -> None:
    page.evaluate("document.querySelectorAll('details').forEach(each => each.open = true)")
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") == 0
    assert page.evaluate(OUTSIDE) == []


def test_wide_tables_scroll_by_themselves_on_a_phone(report: Path, browser: Any) -> None:
    page = browser.new_page(viewport={"width": 390, "height": 900})
    page.goto(report.as_uri())
    page.evaluate("document.querySelectorAll('details').forEach(each => each.open = true)")
    page.add_style_tag(content="table { min-width: 60rem; }")  # whatever the names, now they are all too wide
    regions = page.locator(".scroll:has(table)")
    assert regions.count() >= 6
    for region in regions.all():
        name = region.get_attribute("aria-label")
        assert region.get_attribute("tabindex") == "0", name  # so that the arrow keys scroll it
        assert region.evaluate("e => { e.scrollLeft = 9999; return e.scrollLeft; }") > 0, name
    assert page.locator("table").count() == page.locator(".scroll table").count()
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") == 0
    page.close()


def test_labels_of_the_map_do_not_overlap(page: Any) -> None:
    assert page.evaluate(TEXTS_THAT_OVERLAP, "[aria-label='Map of the sites']") == []
