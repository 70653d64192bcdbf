"""Time and memory of the explorer for a large scene: a million triangles around 5 hectares.

The scene is one of :mod:`benchmarks.scaling`. Prints what :mod:`benchmarks.explorer` prints, and the time per frame of
a headless browser (software rendering) while the camera turns, and the browser's memory.

    python -m benchmarks.explorer_large [--triangles 1000000] [--hectares 5] [--no-browser]
"""

from __future__ import annotations

import argparse
import random
import shutil
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import scaling
from benchmarks.explorer import memory_mb, random_move, time_move_ms
from egvs.explore.page import Page
from egvs.explore.settings import open_session

GRAPHICS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
_FRAMES = """seconds => new Promise(done => {
    const times = []; let last = performance.now(); const end = last + 1000 * seconds;
    const tick = now => { times.push(now - last); last = now; now < end ? requestAnimationFrame(tick) : done(times); };
    requestAnimationFrame(tick);
})"""


def main() -> None:
    """Make and open the scene, move sensors, and measure a browser."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--triangles", type=int, default=1_000_000)
    parser.add_argument("--hectares", type=float, default=5.0)
    parser.add_argument("--moves", type=int, default=50)
    parser.add_argument("--browser", action=argparse.BooleanOptionalAction, default=True)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scenario = scaling.prepare(
            scaling.Size(triangles=options.triangles, hectares=options.hectares, beams=57_600), folder / "large"
        )
        begin = time.perf_counter()
        session = open_session(scenario, (), folder / "run")
        ran_s = time.perf_counter() - begin
        page = Page(session, folder / "page")
        grid, faces = session.tpog.grid, len(session.scene.world.faces)
        print(f"{faces:,} triangles, {grid.shape} voxels, {len(session.candidates)} candidates; run {ran_s:.0f} s, "
              f"opened {time.perf_counter() - begin - ran_s:.1f} s, {memory_mb():.0f} MB")  # fmt: skip
        loop = threading.Thread(target=page.run)
        loop.start()
        try:
            rng, sites = random.Random(1), [candidate.site for candidate in session.ranked]
            times_ms = [time_move_ms(page, random_move(rng.choice(sites), rng)) for _ in range(options.moves)]
            median, high = np.percentile(times_ms, [50, 95])
            print(f"a move: median {median:.0f} ms, 95 % within {high:.0f} ms, {memory_mb():.0f} MB")
            if options.browser:
                _measure_browser(page)
        finally:
            page.end()
            loop.join()
            page.stop()


def _measure_browser(page: Page) -> None:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = shutil.which("chromium") or shutil.which("chromium-browser")
        browser = playwright.chromium.launch(executable_path=chromium, args=GRAPHICS)
        tab = browser.new_page(viewport={"width": 1200, "height": 720})
        begin = time.perf_counter()
        tab.goto(page.address)
        tab.get_by_text("rank ").first.wait_for(timeout=300_000)
        print(f"page shown after {time.perf_counter() - begin:.1f} s")
        tab.wait_for_timeout(20_000)
        print(f"frame while nothing moves: {_frame_ms(tab):.0f} ms")
        tab.mouse.move(300, 300)
        tab.mouse.down()
        for step in range(6):
            tab.mouse.move(300 + 20 * step, 300)
        print(f"frame while the camera turns: {_frame_ms(tab):.0f} ms (in software)")
        tab.mouse.up()
        print(f"the browser's heap: {tab.evaluate('performance.memory.usedJSHeapSize') / 1e6:.0f} MB")
        browser.close()


def _frame_ms(tab: Any) -> float:
    return float(np.median(tab.evaluate(_FRAMES, 10)))


if __name__ == "__main__":
    main()
