"""The page of a city run in a browser as wide as a phone: nothing overlaps, and nothing is wider than the page."""

from __future__ import annotations

from pathlib import Path

import pytest

from egvs.extensions.city import page
from tests.accessibility import violations
from tests.chromium import needs_chromium, open_chromium
from tests.extensions.city.test_page import make_city, make_plan, make_result

pytestmark = [
    pytest.mark.slow,
    pytest.mark.system,
    needs_chromium,
]

CUT_CELLS = """() => [...document.querySelectorAll("td, th")]
    .filter(e => e.scrollWidth > e.clientWidth + 1 && !e.closest("thead")).map(e => e.textContent.trim())"""


@pytest.mark.parametrize("width", [390, 1280])
def test_cells_of_the_tables_do_not_overlap(tmp_path: Path, width: int) -> None:
    streets = "signalised junction of Bismarckstraße and Donaudampfschifffahrtsgesellschaftsstraße"
    results = (make_result("cluster_1423165998_1698047149", 1, 90.0, streets), make_result("b", 2, 30.0, streets))
    html = page.render_page(make_city(*results), results, (), make_plan("count", (1, 2)))
    (tmp_path / "city.html").write_text(html, encoding="utf-8")
    with open_chromium() as browser:
        opened = browser.new_page(viewport={"width": width, "height": 900})
        opened.goto((tmp_path / "city.html").as_uri())
        assert opened.evaluate(CUT_CELLS) == []
        assert violations(opened) == []
        assert opened.evaluate("document.documentElement.scrollWidth - innerWidth") == 0
