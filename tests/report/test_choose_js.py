"""A browser shows the views of a chosen site as the program would draw them."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.chromium import needs_chromium, open_chromium
from tests.report.small_runs import decode_png, render_report, run_to_scores

pytestmark = [
    pytest.mark.slow,
    pytest.mark.system,
    needs_chromium,
]


SITES = [("north", 6, 9, 2), ("south", 6, -1, 2), ("<b>east", 14, 4, 3)]


WORST = [["<i>eastbound</i> left-turn lane: 41 % seen", "± 8 %, from 12 vehicles in 120 observations"]] * 2


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a small run with its report."""
    scenario, out = run_to_scores(tmp_path_factory.mktemp("choosing"), sites=SITES)
    report, text = out / "report.html", render_report(scenario, out)
    data = json.loads(re.search(r'id="site-data">(.*?)</script>', text, re.DOTALL).group(1))
    vehicles = data["sites"]["south"]["vehicles"]  # the run has no network: pretend that it has two bad lanes
    vehicles |= {"worst": WORST, "numbers": [[100.5, 200.0], [50, 60], None, None, None], "note": "<b>all"}
    changed = json.dumps(data).replace("<", "\\u003c")
    report.write_text(
        re.sub(r'(?s)(id="site-data">).*?(?=</script>)', lambda m: m[1] + changed, text), encoding="utf-8"
    )
    return out


@pytest.fixture(params=["light", "dark"])
def browser_page(run: Path, request: pytest.FixtureRequest) -> Iterator[Any]:
    """The report, open in a browser."""
    with open_chromium() as browser:
        opened = browser.new_page(color_scheme=request.param, viewport={"width": 1200, "height": 900})
        errors: list[str] = []
        opened.on("pageerror", lambda error: errors.append(str(error)))
        opened.goto((run / "report.html").as_uri())
        yield opened
        assert errors == []


def displayed_image(opened: Any, kind: str) -> list[int]:
    """Palette indices of the image that the first panel shows, read from the bytes that the page has joined."""
    uri = opened.evaluate(
        """async kind => {
            const svg = document.querySelector(`[data-panel="1"] [data-view=${kind}] svg`);
            const image = [...svg.querySelectorAll(".field")].find(i => getComputedStyle(i).display !== "none");
            const bytes = new Uint8Array(await (await fetch(image.getAttribute("href"))).arrayBuffer());
            return "data:image/png;base64," + btoa(String.fromCharCode(...bytes));
        }""",
        kind,
    )
    return decode_png(uri).ravel().tolist()


def expected_image(run: Path, site: str, kind: str) -> list[int]:
    """Those of the image that the page holds for a site."""
    text = (run / "report.html").read_text(encoding="utf-8")
    data = json.loads(re.search(r'id="site-data">(.*?)</script>', text, re.DOTALL).group(1))
    head, pixels = data["sites"][site]["images"][kind]

    palette = data["palettes"]["day"].get(kind, data["palettes"]["day"]["field"])
    parts = (head, palette, pixels, data["end"])
    joined = base64.b64encode(b"".join(map(base64.b64decode, parts))).decode()
    return decode_png(f"data:image/png;base64,{joined}").ravel().tolist()


def test_every_site_can_be_chosen(browser_page: Any, run: Path) -> None:
    names = browser_page.locator('[data-panel="1"] option').evaluate_all("all => all.map(o => o.value)")
    assert sorted(names) == sorted(name for name, *_ in SITES)
    images = {}
    for name in names:
        browser_page.locator('[data-panel="1"] select').select_option(name)
        images[name] = {kind: displayed_image(browser_page, kind) for kind in ("seen", "missed", "scan", "vehicles")}
        assert images[name] == {kind: expected_image(run, name, kind) for kind in images[name]}
        assert browser_page.locator('[data-panel="1"] figcaption').inner_text().startswith(f"{name}: rank ")
    assert len({str(image["seen"]) for image in images.values()}) == len(names)


def test_lists_and_numbers_the_worst_locations_of_a_chosen_site(browser_page: Any) -> None:
    panel = browser_page.locator('[data-panel="1"]')
    visible_marks = """all => all.filter(m => getComputedStyle(m).display !== "none")
        .map(m => m.textContent + " " + m.getAttribute("transform"))"""
    marks = panel.locator("g.worst")
    panel.locator("select").select_option("south")
    assert panel.locator(".worst-places li").all_inner_texts() == ["\n".join(place) for place in WORST]
    assert panel.locator(".worst-note").inner_text() == "<b>all"
    assert marks.evaluate_all(visible_marks) == ["1 translate(100.5 200)", "2 translate(50 60)"]
    panel.locator("select").select_option("north")
    assert panel.locator(".worst-places li").count() == 0 and marks.evaluate_all(visible_marks) == []
    assert "see the map" in panel.locator(".worst-note").inner_text()


def test_click_in_the_ranking_or_on_the_map_chooses_a_site(browser_page: Any) -> None:
    chosen = browser_page.locator('[data-panel="1"] select')
    browser_page.locator('a[data-site="south"]').click()
    assert chosen.input_value() == "south"
    browser_page.locator('g[data-site="north"]').click()
    assert chosen.input_value() == "north"


def test_nothing_is_wider_than_the_page(browser_page: Any) -> None:
    for width in (1200, 390):
        browser_page.set_viewport_size({"width": width, "height": 900})
        cut = browser_page.evaluate(
            """() => [...document.querySelectorAll("body, .scroll")]
                .filter(e => e.scrollWidth > e.clientWidth + 1).map(e => e.getAttribute("aria-label") || e.tagName)"""
        )
        assert cut == []
