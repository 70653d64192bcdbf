"""The page in a real browser: from an empty folder to a plan and its files, one mistake in each part, and axe's rules.

Every test fails on errors in the console. Refusals of the server (422 and the like) are no errors; browsers print them.
"""

from __future__ import annotations

import base64
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

import egvs
from egvs.extensions.desk.server import STATIC
from tests.accessibility import violations
from tests.chromium import SOFTWARE_GRAPHICS, needs_chromium, open_chromium
from tests.conftest import write_mini
from tests.extensions.desk.conftest import MAP, write_inline_plan, write_periods
from tests.extensions.desk.serving import serving
from tests.extensions.desk.test_aerial import write_picture

WAIT_MS, JOB_MS = 20_000, 180_000
REFUSED = re.compile(r"Failed to load resource: .* status of 4(09|13|15|22) ")
BERLIN = Path(__file__).parents[4] / "shared" / "real" / "berlin_neukoelln.osm.gz"
"""A real map with street lamps; not part of the project."""
STEPS = ("Poles", "Traffic", "Run", "Decide", "Take along")

pytestmark = [
    needs_chromium,
    pytest.mark.system,
    pytest.mark.slow,
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium."""
    with open_chromium(SOFTWARE_GRAPHICS) as opened:
        yield opened


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder that is served; empty."""
    work = tmp_path / "work"
    work.mkdir()
    return work


@pytest.fixture
def open_page(browser: Any, folder: Path, tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Serve the folder; a function opens the page, in a browser with another language if wished."""
    errors: list[str] = []
    requests: list[str] = []
    with serving(folder, tmp_path / "scratch") as client:
        contexts = []

        def open_it(**options: Any) -> Any:
            context = browser.new_context(**{"viewport": {"width": 1280, "height": 800}, **options})
            contexts.append(context)
            tab = context.new_page()
            tab.set_default_timeout(WAIT_MS)
            tab.on("pageerror", lambda error: errors.append(str(error)))
            tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
            tab.on("request", lambda request: requests.append(request.url))
            tab.goto(client.address)
            tab.locator("h1").wait_for()
            return tab

        yield open_it
        for context in contexts:
            context.close()
    assert [error for error in errors if not REFUSED.match(error)] == []
    assert [url for url in requests if not url.startswith(("http://127.0.0.1:", "blob:", "data:"))] == []


@pytest.fixture
def town(folder: Path, made_town: Path, open_page: Callable[..., Any]) -> Any:
    """A tab with the town open."""
    shutil.copytree(made_town, folder / "town")
    return open_scenario(open_page(), "town")


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scenario ``mini`` and its run."""
    made = tmp_path_factory.mktemp("finished")
    egvs.run(egvs.load(write_mini(made / "mini")), made / "runs" / "mini")
    return made


@pytest.fixture
def finished(folder: Path, finished_run: Path, open_page: Callable[..., Any]) -> Any:
    """A tab with ``mini``, which has results."""
    shutil.copytree(finished_run, folder, dirs_exist_ok=True)
    tab = open_scenario(open_page(), "mini")
    go(tab, "Decide")
    return tab


def open_scenario(tab: Any, name: str) -> Any:
    tab.get_by_role("button", name="Open").and_(tab.get_by_title(f"Open {name}")).click()
    tab.locator(".item.pole").first.wait_for()
    return tab


def state(tab: Any) -> Any:
    return tab.evaluate("fetch('/api/state').then(answer => answer.json())")


def site(tab: Any, name: str) -> Any:
    return next(site for site in state(tab)["project"]["sites"] if site["site"] == name)


def go(tab: Any, step: str) -> None:
    tab.locator("#steps").get_by_role("button", name=step).click()
    tab.get_by_role("heading", level=1, name=step).wait_for()


def pixel(tab: Any, name: str) -> tuple[float, float]:
    """Return where a pole is on the screen."""
    return middle(tab.locator(f'.item[data-id="{name}"] .body'))


def middle(element: Any) -> tuple[float, float]:
    while not (box := element.bounding_box()):  # it was drawn again
        element.page.wait_for_timeout(50)
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def on_screen(tab: Any, x_m: float, y_m: float) -> tuple[float, float]:
    """Return the pixel of a location, from those of two poles that do not move."""
    a, b = (site(tab, name) for name in ("lamp1", "signal1"))
    (ax, ay), (bx, _) = pixel(tab, "lamp1"), pixel(tab, "signal1")
    scale = (bx - ax) / (b["x_m"] - a["x_m"])
    return ax + (x_m - a["x_m"]) * scale, ay - (y_m - a["y_m"]) * scale


def drag(tab: Any, start: tuple[float, float], end: tuple[float, float]) -> None:
    tab.mouse.move(*start)
    tab.mouse.down()
    tab.mouse.move(*end, steps=5)
    tab.mouse.up()


def wait_until(tab: Any, is_so: Callable[[], object]) -> None:
    end_s = time.monotonic() + WAIT_MS / 1000
    while not is_so():
        assert time.monotonic() < end_s, "it does not become so"
        tab.wait_for_timeout(50)


@contextmanager
def narrow(tab: Any) -> Iterator[None]:
    tab.set_viewport_size({"width": 390, "height": 844})
    yield
    tab.set_viewport_size({"width": 1280, "height": 800})


def assert_accessible(tab: Any) -> None:
    """No rule of axe is broken at both widths, and nothing is wider than a phone."""
    assert violations(tab) == []
    with narrow(tab):
        assert violations(tab) == []
        assert tab.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0


def type_into(tab: Any, label: str, text: str) -> Any:
    field = tab.get_by_label(label, exact=True)
    field.fill(text)
    field.press("Enter")
    return field


def write_two_junctions(path: Path) -> Path:
    """Write the made-up town with another junction 100 m east of the first."""
    lane = (
        '<node id="9001" lat="52.0000000" lon="10.0014561"/><node id="9002" lat="52.0010000" lon="10.0014561"/>'
        '<way id="9003"><nd ref="9001"/><nd ref="9002"/><tag k="highway" v="residential"/>'
        '<tag k="name" v="Mill Lane"/></way>'
    )
    street = '<way id="1001"><nd ref="101"/><nd ref="1"/>'
    text = MAP.read_text(encoding="utf-8")
    assert street in text
    path.write_text(text.replace(street, f'{lane}{street}<nd ref="9001"/>'), encoding="utf-8")
    return path


def test_from_an_empty_folder_to_a_plan_and_its_files(
    open_page: Callable[..., Any], folder: Path, tmp_path: Path
) -> None:
    tab = open_page(accept_downloads=True)
    assert_accessible(tab)
    tab.set_input_files("#map-file", write_two_junctions(tmp_path / "streets.osm"))
    tab.get_by_role("heading", name="Which junction?").wait_for(timeout=JOB_MS)
    junction = tab.get_by_role("button", name="East Street and North Street")
    assert junction.get_attribute("aria-pressed") == "true"
    tab.mouse.click(*middle(tab.locator(".item.junction:not(.selected) .body").last))
    assert junction.get_attribute("aria-pressed") == "false"
    assert tab.get_by_label("Poles of the map").is_checked()
    credit = tab.get_by_text("Map data (c) OpenStreetMap contributors, ODbL")
    assert credit.is_visible()
    tab.get_by_text("Aerial picture", exact=True).click()
    tab.set_input_files("#picture-file", write_picture(tmp_path / "town.tif", 10.0, 52.0))
    tab.locator(".picture image").wait_for()
    assert_accessible(tab)
    junction.click()
    type_into(tab, "Name", "town")
    tab.get_by_role("button", name="Make the scenario").click()

    tab.get_by_role("button", name="signal1").click(timeout=JOB_MS)
    credit.wait_for()
    assert tab.locator(".picture image").get_attribute("href").startswith("/api/aerial?")
    tab.locator(".maptools").get_by_role("button", name="Aerial picture").click()
    assert tab.locator(".picture image").count() == 0
    assert "signal mast" in tab.get_by_role("region", name="Pole signal1").inner_text()
    type_into(tab, "Height", "4,5")
    wait_until(tab, lambda: site(tab, "signal1")["z_m"] == 4.5)
    type_into(tab, "Heights, m", "4 6")
    type_into(tab, "Tilts, °", "-5")
    wait_until(tab, lambda: state(tab)["project"]["mounts"]["pitch_deg"] == [-5])
    tab.get_by_role("button", name="Add a pole").click()
    tab.mouse.click(*on_screen(tab, 211.5, 211.0))
    tab.get_by_role("region", name="Pole new1").wait_for()
    x, y = pixel(tab, "new1")
    drag(tab, (x, y), (x + 12, y - 12))
    wait_until(tab, lambda: site(tab, "new1")["x_m"] > 211.6)
    moved = site(tab, "new1")
    tab.keyboard.press("Control+z")
    wait_until(tab, lambda: site(tab, "new1")["x_m"] < moved["x_m"])
    tab.keyboard.press("Control+Shift+z")
    wait_until(tab, lambda: site(tab, "new1") == moved)
    assert_accessible(tab)

    tab.get_by_role("button", name="Next: Traffic").click()
    fields = tab.locator(".approach input")
    fields.nth(0).fill("300")
    fields.nth(0).press("Tab")
    wait_until(tab, lambda: state(tab)["project"]["counts"][0]["movements"][0]["count_per_h"] == 300)
    fields.nth(1).fill("28,5")
    fields.nth(1).press("Enter")
    wait_until(tab, lambda: state(tab)["project"]["counts"][0]["movements"][1]["count_per_h"] == 28.5)
    assert_accessible(tab)

    tab.get_by_role("button", name="Next: Run").click()
    tab.get_by_label("Moments of traffic").fill("60")
    tab.get_by_label("Moments of traffic").press("Enter")
    wait_until(tab, lambda: state(tab)["project"]["settings"]["frames"] == 60)
    assert_accessible(tab)
    tab.get_by_role("button", name="Start the run").click()
    tab.get_by_role("button", name="Stop").wait_for()
    assert violations(tab) == []
    tab.get_by_role("heading", name="Ranking").wait_for(timeout=JOB_MS)
    table = tab.get_by_role("table", name="Poles, best first")
    assert sorted(table.locator("tbody th").all_inner_texts()) == ["lamp1", "new1", "signal1"]
    tab.get_by_text("the most serious first").click()
    tab.locator(".warnings li", has_text="60 frames").wait_for()
    assert_accessible(tab)

    tab.get_by_role("button", name="Next: Decide").click()
    tab.get_by_role("button", name="Find the best 2 poles").click()
    tab.get_by_role("heading", name="2 sensors").wait_for(timeout=JOB_MS)
    assert tab.locator(".item.sensor").count() == 2
    stage, panel = (tab.locator(part).bounding_box() for part in ("#stage", "#panel"))
    assert stage["x"] + stage["width"] <= panel["x"]  # side by side
    tab.get_by_role("button", name="Keep, to compare").click()
    tab.get_by_role("slider", name="Sensors").press("ArrowLeft")
    tab.get_by_role("heading", name="1 sensor:").wait_for(timeout=JOB_MS)
    assert tab.get_by_role("table", name="The plan that was kept, and this one").locator(
        "tbody tr"
    ).first.inner_text().split() == ["Sensors", "2", "1"]
    assert_accessible(tab)

    go(tab, "Take along")
    tab.get_by_title("Save GeoPackage").wait_for()
    assert_accessible(tab)
    for title, begin in (("Save GeoPackage", b"SQLite"), ("Save Report", b"<!DOCTYPE html>")):
        with tab.expect_download(timeout=JOB_MS) as download:
            tab.get_by_title(title).click()
        assert Path(download.value.path()).read_bytes().startswith(begin)
    assert (folder / "town" / "scenario.toml").is_file() and (folder / "runs" / "town" / "scores.parquet").is_file()


@pytest.mark.parametrize("source", [MAP, BERLIN], ids=["made_up", "berlin"])
def test_planned_in_the_browser_is_ranked_the_same_by_the_command_line(
    source: Path, open_page: Callable[..., Any], folder: Path, tmp_path: Path
) -> None:
    if not source.is_file():
        pytest.skip(f"{source.name} is not beside the checkout (shared/real)")
    tab = open_page(accept_downloads=True)
    tab.set_input_files("#map-file", source)
    tab.get_by_role("heading", name="Which junction?").wait_for(timeout=JOB_MS)
    tab.locator("tbody tr", has_text="yes").first.get_by_role("button").click()
    type_into(tab, "Name", "junction")
    tab.get_by_role("button", name="Make the scenario").click()
    tab.locator(".item.pole.existing").first.wait_for(timeout=JOB_MS)
    existing = [site["site"] for site in state(tab)["project"]["sites"]]
    tab.get_by_role("button", name="Show kerb positions").click()
    tab.locator(".item.suggestion").first.wait_for()
    tab.mouse.click(*middle(tab.locator(".item.suggestion .body").first))
    wait_until(tab, lambda: len(state(tab)["project"]["sites"]) == len(existing) + 1)
    type_into(tab, "Heights, m", "4,5")
    type_into(tab, "Tilts, °", "-5")
    wait_until(tab, lambda: state(tab)["project"]["mounts"]["pitch_deg"] == [-5])

    tab.get_by_role("button", name="Next: Traffic").click()
    fields = tab.locator(".approach input")
    for number, count in enumerate((90, 28.5)):
        fields.nth(number).fill(str(count))
        fields.nth(number).press("Enter")
    wait_until(
        tab, lambda: [m["count_per_h"] for m in state(tab)["project"]["counts"][0]["movements"]].count(28.5) == 1
    )
    tab.get_by_role("button", name="Next: Run").click()
    type_into(tab, "Moments of traffic to record, one every 1 s", "500")
    wait_until(tab, lambda: state(tab)["project"]["settings"]["frames"] == 500)
    tab.get_by_role("button", name="Start the run").click()
    tab.get_by_role("heading", name="Ranking").wait_for(timeout=JOB_MS)
    tab.get_by_role("button", name="Next: Decide").click()
    find = tab.get_by_role("button", name="Find the best 2 poles")
    find.click()
    planned = tab.get_by_role("heading", name="2 sensors:")
    planned.wait_for(timeout=JOB_MS)
    first = tab.locator(".item.sensor").first.get_attribute("data-id")
    before = site(tab, first)
    for step in ((8, 0), (0, 8), (-8, 0), (0, -8), (16, 0), (0, 16), (-16, 0), (0, -16)):
        x, y = pixel(tab, first)
        drag(tab, (x, y), (x + step[0], y + step[1]))
        dialog = tab.get_by_role("dialog").get_by_role("button", name="Change", exact=True)
        refusal = tab.get_by_text("Not here:").first
        dialog.or_(refusal).first.wait_for()
        if dialog.is_visible():
            dialog.click()
            break
    wait_until(tab, lambda: site(tab, first) != before)
    tab.get_by_role("heading", name="Plan before the changes").wait_for()
    find.click()
    planned.wait_for(timeout=JOB_MS)
    tab.get_by_role("button", name="Parked lorry").click()
    wait_until(tab, lambda: len(state(tab)["project"]["obstacles"]) == 1)
    tab.get_by_role("button", name="What changes?").click()
    tab.get_by_text(re.compile("^With obstacles, the plan of 2 sensors changes from ")).wait_for(timeout=JOB_MS)

    go(tab, "Take along")
    for title, begin in (("Installation sheets", b"PK"), ("GeoPackage", b"SQLite")):
        with tab.expect_download(timeout=JOB_MS) as download:
            tab.get_by_title(f"Save {title}").click()
        assert Path(download.value.path()).read_bytes().startswith(begin)
    words = [sys.executable, "-m", "egvs", "run", "junction", "--out", str(tmp_path / "again")]
    subprocess.run(words, cwd=folder, check=True, capture_output=True)
    scores = [run / "scores.parquet" for run in (folder / "runs" / "junction", tmp_path / "again")]
    assert scores[0].read_bytes() == scores[1].read_bytes()


def test_counts_are_a_list_where_they_have_no_room_on_the_map(town: Any) -> None:
    go(town, "Traffic")
    assert town.locator(".diagram.listed").count() == 0
    town.set_viewport_size({"width": 1280, "height": 360})
    town.locator(".diagram.listed").wait_for()
    boxes = [card.bounding_box() for card in town.locator(".approach").all()]
    assert all(above["y"] + above["height"] <= below["y"] for above, below in pairwise(boxes))
    field = town.locator(".approach input").last
    field.fill("31")
    field.press("Enter")
    wait_until(town, lambda: state(town)["project"]["counts"][0]["movements"][-1]["count_per_h"] == 31)
    assert violations(town) == []
    town.set_viewport_size({"width": 1280, "height": 800})
    town.locator(".diagram:not(.listed)").wait_for()


def test_broken_map_is_explained(open_page: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "broken.osm").write_bytes(b"<osm version='0.6'><script>alert(1)</script>")
    tab = open_page()
    tab.set_input_files("#map-file", tmp_path / "broken.osm")
    message = tab.locator("#message.error")
    message.wait_for()
    assert "is not well-formed XML" in message.inner_text()
    tab.get_by_role("button", name="Close the message").click()
    assert message.count() == 0
    assert tab.get_by_text("Choose a map file").is_visible()


def test_picture_of_another_place_is_explained(town: Any, tmp_path: Path) -> None:
    town.get_by_text("Aerial picture", exact=True).click()
    town.set_input_files("#picture-file", write_picture(tmp_path / "far.tif", 13.4, 52.5))
    message = town.locator("#message.error")
    message.wait_for()
    assert "far.tif: does not show this junction, but a place 239 km away" in message.inner_text()
    make = "text => { const data = new DataTransfer(); data.items.add(new File([BYTES], 'here.tif')); return data; }"
    here = base64.b64encode(write_picture(tmp_path / "here.tif", 10.0, 52.0).read_bytes()).decode()
    dropped = town.evaluate_handle(make.replace("BYTES", "Uint8Array.from(atob(text), c => c.charCodeAt(0))"), here)
    town.dispatch_event("#stage", "drop", {"dataTransfer": dropped})
    town.locator(".picture image").wait_for()
    assert message.count() == 0
    town.get_by_role("button", name="Remove the picture").click()
    wait_until(town, lambda: state(town)["project"]["aerial"] is None)
    wait_until(town, lambda: town.locator(".picture image").count() == 0)


def test_text_of_files_is_never_markup(open_page: Callable[..., Any], folder: Path) -> None:
    mini = write_mini(folder / "mini")
    toml = mini / "scenario.toml"
    toml.write_text('description = "<img src=x onerror=alert(1)> & <b>bold</b>"\n' + toml.read_text())
    tab = open_page()
    assert "<b>bold</b>" in tab.locator(".rows").first.inner_text()
    open_scenario(tab, "mini")
    assert "<b>bold</b>" in tab.locator("#title").inner_text()
    assert tab.locator("img[src=x]").count() == 0


def test_pole_in_a_lane_is_refused_where_it_is_dropped(town: Any) -> None:
    before = site(town, "lamp1")
    x, y = on_screen(town, 200.0, 200.0)
    drag(town, pixel(town, "lamp1"), (x, y))
    bubble = town.locator(".bubble")
    town.get_by_text("Not here:").first.wait_for()
    assert "junction" in bubble.inner_text() or "lane" in bubble.inner_text()
    box = bubble.bounding_box()
    assert box["x"] - 5 <= x <= box["x"] + box["width"] + 5 and abs(box["y"] + box["height"] - y) < 60
    assert site(town, "lamp1") == before
    assert town.get_by_role("button", name="Undo").is_disabled()


def test_poles_are_moved_with_keys_only(town: Any) -> None:
    town.get_by_role("button", name="lamp1").focus()
    town.keyboard.press("Enter")
    town.get_by_role("application").focus()
    before = site(town, "lamp1")
    town.keyboard.press("Shift+ArrowLeft")
    town.keyboard.press("Shift+ArrowLeft")
    wait_until(town, lambda: site(town, "lamp1")["x_m"] == pytest.approx(before["x_m"] - 0.2, abs=1e-6))
    town.keyboard.press("PageDown")
    town.get_by_role("region", name="Pole signal1").wait_for()
    town.keyboard.press("Delete")
    wait_until(town, lambda: len(state(town)["project"]["sites"]) == 1)
    town.keyboard.press("Control+z")
    wait_until(town, lambda: len(state(town)["project"]["sites"]) == 2)


def test_impossible_counts_are_shown_at_once(town: Any) -> None:
    go(town, "Traffic")
    field = town.locator(".approach input").first
    field.fill("1.234")
    field.press("Enter")
    town.get_by_text("can be 1234 or 1.234").wait_for()
    assert field.get_attribute("aria-invalid") == "true"
    assert violations(town) == []
    field.fill("99999")
    town.get_by_text("More than its").first.wait_for()
    field.press("Escape")
    assert field.get_attribute("aria-invalid") is None
    assert town.get_by_role("button", name="Undo").is_disabled()
    field.fill("1.200")
    town.get_by_role("button", name="Next: Run").click()
    town.locator("#message.error", has_text="Not taken: “1.200” can be 1200 or 1.200.").wait_for()


def test_numbers_of_a_german_browser(folder: Path, made_town: Path, open_page: Callable[..., Any]) -> None:
    shutil.copytree(made_town, folder / "town")
    tab = open_scenario(open_page(locale="de-DE"), "town")
    tab.get_by_role("button", name="lamp1").click()
    type_into(tab, "Height", "4.5")
    wait_until(tab, lambda: site(tab, "lamp1")["z_m"] == 4.5)
    wait_until(tab, lambda: tab.get_by_label("Height", exact=True).input_value() == "4,5")
    type_into(tab, "Heights, m", "3; 5,5 7")
    wait_until(tab, lambda: state(tab)["project"]["mounts"]["heights_m"] == [3, 5.5, 7])


def test_run_is_stopped_and_continued_in_two_tabs(folder: Path, made_town: Path, open_page: Callable[..., Any]) -> None:
    shutil.copytree(made_town, folder / "town")
    tab, other = open_scenario(open_page(), "town"), open_page()
    other.locator(".item.pole").first.wait_for()
    go(tab, "Decide")
    assert "Run first" in tab.locator("#panel").inner_text()
    go(tab, "Take along")
    assert tab.get_by_title("Save GeoPackage").is_disabled()
    go(tab, "Run")
    tab.get_by_role("button", name="Start the run").click()
    other.get_by_role("button", name="Stop").click()
    tab.get_by_text("Run: stopped.").wait_for()
    assert tab.get_by_role("button", name=re.compile("Start the run|Continue the run")).is_enabled()


def test_plan_that_cannot_be_is_explained(finished: Any) -> None:
    tab = finished
    tab.get_by_role("radio", name="budget").check()
    assert tab.get_by_role("button", name="Find the best plan").is_disabled()
    type_into(tab, "Budget", "ten")
    tab.get_by_text("“ten” is not a number.").wait_for()
    type_into(tab, "A sensor costs", "100")
    wait_until(tab, lambda: state(tab)["project"]["costs"]["sensor_costs"] == {"small": 100})
    type_into(tab, "Budget", "5")
    tab.get_by_role("button", name="Find the best plan").click()
    message = tab.locator("#message.error")
    message.wait_for(timeout=JOB_MS)
    assert "budget" in message.inner_text()

    slider = tab.get_by_role("slider", name="Budget from the cheapest to the dearest plan")
    slider.press("Home")
    slider.press("ArrowRight")
    assert tab.get_by_label("Budget", exact=True).input_value() == "105"
    slider.press("End")
    assert slider.get_attribute("aria-valuetext") == "200"
    tab.get_by_role("button", name="Find the best plan").click()
    tab.get_by_text("Costs 200.").wait_for(timeout=JOB_MS)
    slider.press("Home")
    tab.get_by_text("Costs 100.").wait_for(timeout=JOB_MS)
    assert_accessible(tab)


def test_recorded_traffic_is_shown_on_the_map(finished: Any) -> None:
    tab = finished
    go(tab, "Run")
    vehicles = tab.locator("g.vehicles path")
    assert vehicles.count() == 0
    tab.get_by_role("button", name="Show the traffic on the map").click()
    vehicles.wait_for(state="attached")
    slider = tab.get_by_role("slider", name="Moment")
    number = int(tab.locator("#moment-text").inner_text().split(": ")[1].split()[0])
    drawn = vehicles.get_attribute("d")
    assert drawn.count("M") == number > 0
    slider.press("ArrowRight")
    assert vehicles.get_attribute("d") != drawn
    tab.get_by_role("button", name="Play").click()
    wait_until(tab, lambda: slider.input_value() not in ("0", "1"))
    tab.get_by_role("button", name="Pause").click()
    assert_accessible(tab)
    go(tab, "Decide")
    assert vehicles.count() == 0


def test_results_stay_until_a_change_is_confirmed(finished: Any, folder: Path) -> None:
    tab, sites = finished, folder / "mini" / "sites.csv"
    before = sites.read_text()
    tab.get_by_role("button", name="Find the best 2 poles").click()
    tab.get_by_text("Vehicles that only this sensor finds").first.wait_for(timeout=JOB_MS)
    assert tab.get_by_role("button", name="Try it").is_disabled()  # no sensor is chosen
    tab.get_by_label("Pole", exact=True).select_option("pole_b")
    tab.get_by_label("Sensor to try").select_option("VLP-16")
    tab.get_by_role("button", name="Try it").click()
    tab.locator("#panel").get_by_text("With VLP-16 on pole_b").wait_for(timeout=JOB_MS)
    assert_accessible(tab)
    assert sites.read_text() == before

    dialog = tab.get_by_role("dialog", name="The results will be out of date")
    tab.get_by_role("button", name="Write it to the list of poles").click()
    dialog.wait_for()
    assert has_focus(tab, "Keep the results")
    assert violations(tab) == []
    tab.keyboard.press("Escape")
    dialog.wait_for(state="detached")
    wait_until(tab, partial(has_focus, tab, "Write it to the list of poles"))
    assert (sites.read_text(), state(tab)["project"]["run"]["state"]) == (before, "complete")
    tab.keyboard.press("Enter")
    dialog.get_by_role("button", name="Change").click()
    tab.get_by_text("pole_b has the sensor VLP-16 now.").wait_for()
    assert "pole_b,30.5,-12,3,VLP-16" in sites.read_text()
    assert state(tab)["project"]["run"]["state"] == "outdated"
    tab.get_by_role("button", name="Undo").click()
    wait_until(tab, lambda: state(tab)["project"]["run"]["state"] == "complete")
    go(tab, "Poles")
    tab.get_by_role("button", name="pole_a").click()
    type_into(tab, "Height", "5")
    wait_until(tab, lambda: site(tab, "pole_a")["z_m"] == 5)  # it is asked once


def test_change_that_is_not_agreed_to_is_taken_back(finished: Any) -> None:
    tab = finished
    go(tab, "Poles")
    tab.get_by_role("button", name="pole_a").click()
    keep = tab.get_by_role("button", name="Keep the results")
    type_into(tab, "Height", "5")
    keep.click()
    wait_until(tab, lambda: tab.get_by_label("Height", exact=True).input_value() == "3")
    x, y = pixel(tab, "pole_a")
    drag(tab, (x, y), (x + 20, y))
    keep.click()
    wait_until(tab, lambda: pixel(tab, "pole_a") == (x, y))
    assert site(tab, "pole_a")["z_m"] == 3
    assert tab.get_by_role("button", name="Undo").is_disabled()


def test_signal_times_are_typed_at_the_bars(town: Any, folder: Path) -> None:
    go(town, "Traffic")
    diagram = town.get_by_role("img", name="Cycle of")
    assert diagram.locator("rect.green").count() == 4
    times = [phase["green_s"] for phase in state(town)["project"]["signals"][0]["phases"]]
    field = town.get_by_label("Green, stage 1", exact=True)
    field.fill("0")
    town.get_by_text("The smallest value is 1.").wait_for()
    field.fill("2")
    town.get_by_text(re.compile("East Street .*more vehicles than its green can carry")).first.wait_for()
    field.fill("33,5")
    assert f"Cycle of {33.5 + times[1] + 10:.0f} s" in diagram.get_attribute("aria-label")
    field.press("Enter")
    wait_until(town, lambda: state(town)["project"]["signals"][0]["phases"][0]["green_s"] == 33.5)
    assert_accessible(town)
    town.keyboard.press("Control+z")
    wait_until(town, lambda: [phase["green_s"] for phase in state(town)["project"]["signals"][0]["phases"]] == times)
    write_inline_plan(folder / "town")
    town.get_by_text("is in scenario.toml; edit it there.").wait_for(timeout=JOB_MS)
    assert diagram.count() == 0


def test_counts_are_typed_by_period(folder: Path, made_town: Path, open_page: Callable[..., Any]) -> None:
    write_periods(shutil.copytree(made_town, folder / "town"))
    tab = open_scenario(open_page(), "town")
    go(tab, "Traffic")
    tab.get_by_label("Period").select_option("evening")
    field = tab.locator(".approach input").first
    field.fill("99999")
    tab.get_by_text("More than its").first.wait_for()
    field.fill("77")
    field.press("Enter")
    wait_until(tab, lambda: state(tab)["project"]["counts"][1]["movements"][0]["count_per_h"] == 77)
    assert tab.get_by_label("Period").input_value() == "evening"
    assert state(tab)["project"]["counts"][0]["movements"][0]["count_per_h"] != 77
    assert_accessible(tab)


def test_lorry_is_dropped_on_the_map(finished: Any) -> None:
    tab = finished
    tab.get_by_role("button", name="Parked lorry").click()
    x, y = middle(tab.locator(".outlines .obstacle"))
    before = state(tab)["project"]["obstacles"][0]
    drag(tab, (x, y), (x - 40, y))
    wait_until(tab, lambda: state(tab)["project"]["obstacles"][0]["x_m"] < before["x_m"])
    tab.get_by_role("button", name="What changes?").click()
    table = tab.get_by_role("table", name="Scores with and without the obstacles")
    table.wait_for(timeout=JOB_MS)
    assert "pole_" in table.inner_text()
    assert_accessible(tab)
    tab.get_by_title("Remove lorry1").click()
    wait_until(tab, lambda: state(tab)["project"]["obstacles"] == [])


def test_3d_follows_the_chosen_pole(finished: Any) -> None:
    tab = finished
    tab.mouse.click(*pixel(tab, "pole_a"))
    tab.get_by_role("button", name="3D", exact=True).click()
    x_m = tab.frame_locator("iframe").get_by_label("x (m)")
    x_m.wait_for(timeout=JOB_MS)
    assert "fixedDpr=0.5" in tab.frames[1].url
    wait_until(tab, lambda: float(x_m.input_value()) == site(tab, "pole_a")["x_m"] == 10)
    assert violations(tab) == []
    (x, y), (end_x, _) = pixel(tab, "pole_a"), pixel(tab, "pole_b")
    scale = (end_x - x) / 20.5
    drag(tab, (x, y), (x - scale, y))
    tab.get_by_role("dialog").get_by_role("button", name="Change", exact=True).click(timeout=JOB_MS)
    wait_until(tab, lambda: float(x_m.input_value()) == site(tab, "pole_a")["x_m"] < 10)
    moved = site(tab, "pole_a")
    drag(tab, (x - scale, y), (x + 6 * scale, y + 6 * scale))
    tab.get_by_text("Not here:").first.wait_for()
    assert site(tab, "pole_a") == moved and float(x_m.input_value()) == moved["x_m"]
    tab.get_by_role("button", name="3D", exact=True).click()
    wait_until(tab, lambda: len(tab.frames) == 1)


def test_scenario_is_sent_as_one_file(open_page: Callable[..., Any], folder: Path, tmp_path: Path) -> None:
    write_mini(folder / "mini")
    tab = open_scenario(open_page(accept_downloads=True), "mini")
    go(tab, "Take along")
    with tab.expect_download(timeout=JOB_MS) as download:
        tab.get_by_title("Save Scenario").click()
    download.value.save_as(tmp_path / "sent.zip")
    tab.get_by_role("button", name="egvs desk").click()
    tab.set_input_files("#map-file", tmp_path / "sent.zip")
    wait_until(tab, lambda: (state(tab)["project"] or {}).get("name") == "sent")
    assert (folder / "sent" / "sites.csv").read_bytes() == (folder / "mini" / "sites.csv").read_bytes()


def test_numbers_as_people_type_them(open_page: Callable[..., Any]) -> None:
    expected: dict[str, float | None] = {
        "8,5": 8.5, "8.5": 8.5, " 12 ": 12, "-3,25": -3.25, "−3": -3, "1 234,5": 1234.5, "1.234,5": 1234.5,
        "1,234.5": 1234.5, "1.234.567": 1234567, "1234,567": 1234.567, "0.125": 0.125, "0,125": 0.125, ",5": 0.5,
        "1.234": None, "1,234": None, "1.23.4": None, "1,2,3": None, "1e3": None, "NaN": None, "ten": None, "": None,
        "12-": None, "1.234,": None, "12,3456": 12.3456, "-0": 0,
    }  # fmt: skip
    read = """async texts => {
        const { parseNumber } = await import('/static/numbers.js');
        return texts.map(text => { try { return parseNumber(text); } catch (error) { return null; } });
    }"""
    assert dict(zip(expected, open_page().evaluate(read, list(expected)), strict=True)) == expected


def test_scripts_have_types() -> None:
    """``tsc`` checks the types in the comments; ``npm install -g typescript`` installs it."""
    program = shutil.which("tsc")
    if program is None:
        pytest.skip("no tsc on this machine")
    scripts = sorted(str(script) for script in STATIC.glob("*.js"))
    options = [
        "--noEmit",
        "--allowJs",
        "--checkJs",
        "--strict",
        "--target",
        "es2022",
        "--lib",
        "es2022,dom,dom.iterable",
    ]
    command = [program, *options, "--module", "es2022", "--moduleResolution", "bundler", *scripts]
    checked = subprocess.run(command, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stdout


def test_page_needs_nothing_from_elsewhere() -> None:
    for file in STATIC.iterdir():
        text = file.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
        assert "http" not in text.replace("http://127.0.0.1", ""), file
        assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(|new Function", text), file
        assert file.suffix != ".html" or not re.search(r"\sstyle=|\son[a-z]+=|<script>", text)


def has_focus(tab: Any, name: str) -> bool:
    """Return whether an element whose text begins like this has the focus."""
    text = tab.evaluate("(document.activeElement.textContent || document.activeElement.ariaLabel || '').trim()")
    return str(text).startswith(name)


def tab_to(tab: Any, name: str) -> None:
    """Press the tab key until an element with this text has the focus."""
    for _ in range(120):
        tab.keyboard.press("Tab")
        if has_focus(tab, name):
            return
    raise AssertionError(f"{name} cannot be reached with the tab key")


def test_plan_is_made_with_the_keyboard_only(open_page: Callable[..., Any], folder: Path) -> None:
    write_mini(folder / "mini")
    tab = open_page()
    tab_to(tab, "Open")
    tab.keyboard.press("Enter")
    tab.get_by_role("heading", level=1, name="Poles").wait_for()
    wait_until(tab, partial(has_focus, tab, "Poles"))
    for step in ("Traffic", "Run"):
        tab_to(tab, f"Next: {step}")
        tab.keyboard.press("Enter")
        wait_until(tab, partial(has_focus, tab, step))
    tab_to(tab, "Start the run")
    tab.keyboard.press("Enter")
    tab.get_by_role("heading", name="Ranking").wait_for(timeout=JOB_MS)
    wait_until(tab, partial(has_focus, tab, "Run"))
    tab_to(tab, "Next: Decide")
    tab.keyboard.press("Enter")
    tab_to(tab, "Find the best 2 poles")
    tab.keyboard.press("Enter")
    tab.get_by_role("heading", name="2 sensors").wait_for(timeout=JOB_MS)
    tab_to(tab, "pole_")
    tab.keyboard.press("Enter")
    assert tab.locator(".item.sensor.selected").count() == 1
