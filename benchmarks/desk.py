"""What the desk takes: start, the first click, a dragged pole with and without scores, 3D, and the server's memory.

``python -m benchmarks.desk [--poles 300] [--moves 60]`` serves a folder with the shipped junction, all poles around its
candidates, and a finished run, and drags a pole in Chromium (needs ``egvs[desk,explore]``, playwright and Chromium). A
move is shown when the browser has painted the frame after it. With scores, 200 made-up vehicles are on the map. 3D
shows a pole when the browser has painted twice after the last message of the explorer's server.
"""

from __future__ import annotations

import argparse
import csv
import http.client
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, cycle
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from playwright.sync_api import sync_playwright

import egvs

SCENARIO = Path(__file__).resolve().parent.parent / "scenarios" / "nishishinjuku"
LIMITS = {
    "first answer, s": "1.5", "first click, s": "2.5", "move shown without scores, ms": "60 (95 %: 120)",
    "move shown with scores, ms": "60 (95 %: 120)", "new score of a move, ms": "120 (95 %: 200)",
    "score of the last position, ms": "250", "memory beyond the scenario's, MB": "120",
    "3D after a drag, ms": "500 (95 %: 1000)",
}  # fmt: skip
VEHICLES = 200
WATCH = """() => {
  window.shown = { moves: [], scores: [], last: 0, dropped: 0 };
  addEventListener("pointerup", () => { shown.dropped = performance.timeOrigin + performance.now(); }, true);
  const bubble = document.querySelector(".bubble");
  addEventListener("pointermove", (event) => {
    shown.last = performance.now();
    requestAnimationFrame(() => { const painted = new MessageChannel();
      painted.port1.onmessage = () => shown.moves.push(performance.now() - event.timeStamp);
      painted.port2.postMessage(0); });
  }, true);
  new MutationObserver(() => {
    if (/rank \\d/.test(bubble.textContent)) shown.scores.push(performance.now() - shown.last);
  }).observe(bubble, { subtree: true, childList: true, characterData: true });
}"""

WATCH_3D = """if (window !== top) {
  window.painted = 0;
  const twice = (then) => requestAnimationFrame(() => requestAnimationFrame(then));
  window.Worker = class extends Worker {  // has the connection to the explorer's server
    constructor(...words) {
      super(...words);
      this.addEventListener("message", () => twice(() => { const painted = new MessageChannel();
        painted.port1.onmessage = () => { window.painted = performance.timeOrigin + performance.now(); };
        painted.port2.postMessage(0); }));
    }
  };
}"""


def write_poles(folder: Path, number: int) -> None:
    """Write a sites file with as many poles, spread around those of the scenario."""
    with (SCENARIO / "sites.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    rng = np.random.default_rng(1)
    with (folder / "sites.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        for count, row in zip(range(number), cycle(rows), strict=False):
            x_m, y_m = (
                round(float(row[key]) + rng.uniform(-reach_m, reach_m), 2)
                for key, reach_m in (("x_m", 4.0), ("y_m", 1.0))
            )
            writer.writerow({**row, "site": f"p{count:03}", "x_m": x_m, "y_m": y_m, "z_m": 4})


@contextmanager
def server(folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Serve a folder by the command line; yields the process and the address."""
    command = [sys.executable, "-m", "egvs", "desk", str(folder), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process, process.stdout.readline().split()[0]
        finally:
            process.terminate()


def first_answer_s(folder: Path) -> float:
    """Return the seconds from the start of the command to the first answer."""
    begin = time.perf_counter()
    with server(folder) as (_, address):
        split = urlsplit(address)
        connection = http.client.HTTPConnection(split.netloc)
        connection.request("GET", f"{split.path}?{split.query}")
        assert connection.getresponse().status == 303
        return time.perf_counter() - begin


def memory_mb(pid: int) -> float:
    """Return the memory of a process and its children; pages that several share count once."""
    rows = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8").splitlines()
    pss = next(int(row.split()[1]) for row in rows if row.startswith("Pss:"))
    children = [path.read_text(encoding="utf-8").split() for path in Path(f"/proc/{pid}/task").glob("*/children")]
    return pss / 1000 + sum(memory_mb(int(child)) for child in chain.from_iterable(children))


def scenario_mb(run: Path) -> float:
    """Return the memory of a process that scores sites of the run."""
    code = (
        "import sys, egvs; session = egvs.open_session(sys.argv[1])\n"
        "session.rate('p000', egvs.Pose(x_m=190, y_m=256, z_m=4, yaw_deg=0)); print(flush=True); input()"
    )
    command = [sys.executable, "-c", code, str(run)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        memory = memory_mb(process.pid)
        process.kill()
    return memory


def open_scenario(tab: Any, name: str) -> None:
    """Open a scenario on the start page."""
    tab.get_by_title(f"Open {name}").click()
    tab.locator(".item.pole .body").last.wait_for()
    tab.wait_for_timeout(2000)
    tab.evaluate(WATCH)


def take_hold(tab: Any) -> tuple[float, float]:
    """Take hold of the pole that is drawn above all others; return its place on the page."""
    box = tab.locator(".item.pole .body").last.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    tab.mouse.move(x, y)
    tab.mouse.down()
    return x, y


def drag(tab: Any, moves: int, pause_ms: float) -> dict[str, list[float]]:
    """Move the pole along a circle of 6 pixels; returns milliseconds of moves and scores."""
    tab.evaluate("Object.assign(shown, { moves: [], scores: [] })")
    box = tab.locator(".item.pole .body").last.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for angle in np.linspace(0.0, 2.0 * np.pi, moves):
        tab.mouse.move(x + 6.0 * np.sin(angle), y + 6.0 - 6.0 * np.cos(angle))
        tab.wait_for_timeout(pause_ms)
    tab.wait_for_timeout(1000)
    found: dict[str, list[float]] = tab.evaluate("shown")
    return found


def show_vehicles(tab: Any) -> None:
    """Let the map show vehicles at random places of the region of interest, instead of the few that were recorded."""
    rng = np.random.default_rng(2)
    x_m, y_m, yaw_rad = rng.uniform(160, 220, VEHICLES), rng.uniform(220, 290, VEHICLES), rng.uniform(-3, 3, VEHICLES)
    moment = np.column_stack([x_m, y_m, yaw_rad, np.full(VEHICLES, 4.5), np.full(VEHICLES, 1.8)])
    answer = {"moments": [moment.round(2).tolist()] * 2, "first_s": 0.0, "period_s": 0.5}
    tab.route("**/api/traffic", lambda route: route.fulfill(response=route.fetch(), json=answer))
    tab.get_by_role("button", name="Run").first.click()
    tab.get_by_role("button", name="Show the traffic on the map").click()
    tab.get_by_text(f"{VEHICLES} road users").wait_for()


def three_after_drags_ms(tab: Any, drags: int) -> list[float]:
    """Return how long after the end of a drag the 3D view was painted for the last time."""
    tab.mouse.up()
    tab.get_by_role("button", name="3D", exact=True).click()
    tab.locator("section.three iframe").wait_for(timeout=60_000)
    tab.wait_for_timeout(10_000)
    frame = tab.frames[-1]
    times = []
    for number in range(drags + 1):
        x, y = take_hold(tab)
        tab.mouse.move(x + (6, -6)[number % 2], y, steps=3)
        tab.mouse.up()
        if number == 0:
            tab.get_by_role("dialog").get_by_role("button", name="Change", exact=True).click()
        tab.wait_for_timeout(3000)
        times.append(frame.evaluate("painted") - tab.evaluate("shown.dropped"))
    return times[1:]  # before the first one, the page asks


@contextmanager
def opened(folder: Path) -> Iterator[tuple[subprocess.Popen[str], Any, float]]:
    """Serve a folder and open it in a browser; yields the server, the tab, and the seconds until it can be clicked."""
    with sync_playwright() as playwright:
        path = shutil.which("chromium") or shutil.which("chromium-browser")
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        tab = browser.new_page(viewport={"width": 1280, "height": 800})
        tab.add_init_script(WATCH_3D)
        begin = time.perf_counter()
        with server(folder) as (process, address):
            tab.goto(address)
            tab.get_by_title("Open plain").wait_for()
            yield process, tab, time.perf_counter() - begin
        browser.close()


def measure(folder: Path, moves: int) -> Iterator[tuple[str, list[float]]]:
    """Yield each figure with its values."""
    yield "first answer, s", [first_answer_s(folder) for _ in range(5)]
    with opened(folder) as (_, tab, clickable_s):
        yield "first click, s", [clickable_s]
        open_scenario(tab, "plain")
        take_hold(tab)
        yield "move shown without scores, ms", drag(tab, moves, 30.0)["moves"]
    with opened(folder) as (process, tab, _):
        open_scenario(tab, "shinjuku")
        show_vehicles(tab)
        take_hold(tab)
        drag(tab, 3, 0.0)  # reads the run
        tab.locator(".bubble", has_text=", rank ").wait_for(timeout=120_000)
        found = drag(tab, moves, 400.0)
        yield "move shown with scores, ms", found["moves"]
        yield "new score of a move, ms", found["scores"]
        yield "score of the last position, ms", [drag(tab, moves, 0.0)["scores"][-1] for _ in range(3)]
        used_mb = memory_mb(process.pid)
        yield "3D after a drag, ms", three_after_drags_ms(tab, 10)
    yield "memory beyond the scenario's, MB", [used_mb - scenario_mb(folder / "runs" / "shinjuku")]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the median and the 95th percentile of each figure, with its limit."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.desk", description=__doc__.split("\n")[0])
    parser.add_argument("--poles", type=int, default=300)
    parser.add_argument("--moves", type=int, default=60)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        shutil.copytree(SCENARIO, folder / "shinjuku")
        write_poles(folder / "shinjuku", options.poles)
        toml = folder / "shinjuku" / "scenario.toml"
        toml.write_text(toml.read_text(encoding="utf-8").replace("frames = 5000", "frames = 500"), encoding="utf-8")
        shutil.copytree(folder / "shinjuku", folder / "plain")
        egvs.run(egvs.load(folder / "shinjuku"), folder / "runs" / "shinjuku")
        for name, values in measure(folder, options.moves):
            median, high = np.percentile(values, [50, 95])
            print(f"{name}: {median:.3g} (95 %: {high:.3g}; {len(values)}); limit {LIMITS.get(name, '-')}", flush=True)


if __name__ == "__main__":
    main()
