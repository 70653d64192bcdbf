"""What the explorer takes: from the end of a move to the new number, and the memory after many moves.

Random moves of candidates of a scenario (position, height, yaw, tilt), changes of sensor and of period, all through the
page that a browser would look at, but without a browser: what it takes to draw depends on the graphics card. Prints the
median and the 95th percentile of the time, and the resident memory as it goes.

    python -m benchmarks.explorer scenarios/nishishinjuku --moves 200
"""

from __future__ import annotations

import argparse
import random
import resource
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from egvs.explore.page import Page
from egvs.explore.settings import open_session
from egvs.explore.view_state import LAYERS
from egvs.sensors.sensor import CATALOGUE
from egvs.sensors.sites import Site

_PAGE = resource.getpagesize()


def memory_mb() -> float:
    """Return the resident memory of this process."""
    return int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1]) * _PAGE / 1e6


def random_move(site: Site, rng: random.Random) -> Site:
    """Return a candidate moved to a random pose nearby."""
    pose = site.pose
    return replace(
        site,
        pose=replace(
            pose,
            x_m=round(pose.x_m + rng.uniform(-5, 5), 3),
            y_m=round(pose.y_m + rng.uniform(-5, 5), 3),
            z_m=round(pose.z_m + rng.uniform(0, 4), 3),
            yaw_deg=round(rng.uniform(-180, 180), 2),
            pitch_deg=round(rng.uniform(-20, 5), 2),
        ),
    )


def main() -> None:
    """Move sensors, change sensors and periods, and print times and memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("place", type=Path)
    parser.add_argument("--moves", type=int, default=200)
    parser.add_argument("--sensors", type=int, default=20)
    parser.add_argument("--periods", type=int, default=5)
    parser.add_argument("--layer", choices=list(LAYERS), default="none")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    session = open_session(options.place, (), options.out)
    with tempfile.TemporaryDirectory() as scratch:
        page = Page(session, Path(scratch))
        loop = threading.Thread(target=page.run)
        loop.start()
        try:
            page.request(layer=options.layer)
            page.wait_until_idle(600)
            _measure(page, options)
        finally:
            page.end()
            loop.join()
            page.stop()


def _measure(page: Page, options: argparse.Namespace) -> None:
    rng, sites = random.Random(1), [candidate.site for candidate in page.session.ranked]
    opened = memory_mb()
    moves = [random_move(rng.choice(sites), rng) for _ in range(options.moves)]
    _time_moves(page, moves[:10], len(CATALOGUE), 1 + len(page.session.periods))
    first = memory_mb()
    begin = time.process_time()
    times_ms = _time_moves(page, moves, 0, 0)
    busy_ms = 1000.0 * (time.process_time() - begin) / len(moves)
    _time_moves(page, moves[-1:], options.sensors, options.periods)
    last = memory_mb()
    median, high = np.percentile(times_ms, [50, 95])
    print(
        f"end of a move to the number: median {median:.0f} ms, 95 % within {high:.0f} ms; processors {busy_ms:.0f} ms"
    )
    print(f"memory: {opened:.0f} MB opened, {first:.0f} MB after a few of each, {last:.0f} MB at the end: "
          f"{last / first - 1.0:+.1%}")  # fmt: skip
    again = page.session.rate(page.view.site.name, page.view.site.pose, page.view.site.sensor)
    print(f"the last score equals a fresh one: {again == page.rating}")


def _time_moves(page: Page, moves: list[Site], sensors: int, periods: int) -> list[float]:
    """Make moves and changes of sensor and period; return milliseconds of each move."""
    times_ms = [time_move_ms(page, site) for site in moves]
    for sensor in (list(CATALOGUE) * sensors)[:sensors]:
        time_move_ms(page, replace(page.view.site, sensor=sensor))
    time_move_ms(page, moves[-1])
    names = ("", *page.session.periods)
    for number in range(periods if page.session.periods else 0):
        page.request(period=names[(number + 1) % len(names)])
        page.wait_until_idle(600)
    return times_ms


def time_move_ms(page: Page, site: Site) -> float:
    """Return the time from the end of a move until everything is shown."""
    begin = time.perf_counter()
    page.request(site=site)
    page.wait_until_idle(600)
    return 1000.0 * (time.perf_counter() - begin)


if __name__ == "__main__":
    main()
