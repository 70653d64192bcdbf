"""Maps: directions, labels, rings, roads."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from egvs.core.grid import Grid
from egvs.drawing import maps
from egvs.drawing.maps import Backdrop
from egvs.drawing.svg_figures import FigureStyle, MapFrame
from egvs.results.ranking import RankedSite
from tests.drawing.test_basemap import roads
from tests.report.small_runs import EMPTY_BACKDROP, decode_png, ranked_site


def test_north_is_up_and_east_is_right():
    grid = Grid((0.0, 0.0, 0.0), 1.0, (4, 3, 1))
    field = np.zeros((4, 3))
    field[3, 2], field[0, 0] = 4.0, 1.0
    drawn = maps.occupancy(grid, field, "voxels", EMPTY_BACKDROP, [ranked_site("a", 0, 0, 1, 1.0, 1)], "")
    for png in re.findall(r'href="([^"]+)"', drawn):
        index = decode_png(png)
        assert index.shape == (3, 4) and index[0, 3] == 254 and index[2, 0] == 1 + 253.999 // 2
        assert np.count_nonzero(index) == 2


def test_labels_do_not_overlap():
    candidates = [ranked_site(f"c{n:02}", 5.0 * n, 50.0, 2.0, 100.0 - n, n + 1) for n in range(8)]
    grid = Grid((0.0, 0.0, 0.0), 0.5, (200, 100, 4))
    drawn = maps.site_map(grid, np.zeros((200, 100)), EMPTY_BACKDROP, candidates, "")
    labels = [(float(x), float(y)) for x, y in re.findall(r'class="label" x="([\d.]+)" y="([\d.]+)"', drawn)]
    assert len(labels) == 8
    for i, (x, y) in enumerate(labels):
        for u, v in labels[:i]:
            assert abs(x - u) >= 21 or abs(y - v) >= 12


def test_sites_at_one_location_are_rings_with_the_best_innermost():
    candidates = [
        ranked_site("low", 5.0, 5.0, 2.0, 10.0, 2),
        ranked_site("high", 5.0, 5.0, 4.0, 20.0, 1),
        ranked_site("else", 9.0, 9.0, 4.0, 5.0, 3),
    ]
    drawn = maps.site_map(Grid((0.0, 0.0, 0.0), 0.5, (20, 20, 4)), np.zeros((20, 20)), EMPTY_BACKDROP, candidates, "")
    both = re.search(r'<g class="site first"[^>]*>.*?</g>', drawn).group()
    radii = [(float(r), int(q)) for q, r in re.findall(r'class="q(\d+)".*?r="([\d.]+)"', both)]
    assert len(radii) == 2 and radii[0][0] > radii[1][0] and radii[1][1] == 16
    assert "high, low" in drawn and "height 4 m; low" in both


RADIUS = 9.0


def test_line_to_a_label_begins_at_the_edge_of_the_spot() -> None:
    """In the spot stands its rank."""
    plan = MapFrame((0.0, 0.0, 100.0, 80.0), "m")
    row = [(300.0 + 19.0 * number, 250.0, f"a rather long name {number}", RADIUS) for number in range(6)]
    drawn = maps.labels(plan, row)
    lines = [re.match(r'<path class="lead" d="M([\d.]+) ([\d.]+)L', text) for text in drawn if 'class="lead"' in text]
    assert lines
    for line in lines:
        x, y = map(float, line.groups())
        assert min(abs(math.hypot(x - spot[0], y - spot[1]) - RADIUS) for spot in row) < 0.1


def drawn(folder: Path, sites: list[RankedSite]) -> str:
    grid = Grid((0.0, -10.0, 0.0), 0.5, (100, 40, 4))
    backdrop = Backdrop((), roads(folder, (-10.0, -20.0, 60.0, 20.0)))
    return maps.site_map(grid, np.zeros((100, 40)), backdrop, sites, "")


def test_lanes_are_drawn_in_their_width(tmp_path: Path) -> None:
    figure = drawn(tmp_path, [ranked_site("a", 5.0, 8.0, 3.0, 1.0, 1)])
    widths = dict(re.findall(r'class="lane (\w+)" style="stroke-width:([\d.]+)px"', figure))
    scale = float(re.search(r'class="edge" style="stroke-width:([\d.]+)px"', figure).group(1)) / 4.0  # the crossing's
    assert float(widths["drive"]) == round(3.2 * scale - 1.0, 2)
    assert not re.search(r"M[Mz\"]", figure), "an empty path ends the drawing of all that follow"


def test_street_name_avoids_sites(tmp_path: Path) -> None:
    def places(folder: Path, x_m: float) -> list[str]:
        folder.mkdir()
        return re.findall(r'class="street" transform="translate\(([\d.]+) ', drawn(folder, [site_at(x_m)]))

    def site_at(x_m: float) -> RankedSite:
        return ranked_site("a", x_m, -1.6, 3.0, 1.0, 1)

    (free,), (moved,) = places(tmp_path / "beside", 49.0), places(tmp_path / "on", 23.0)
    assert free != moved


def test_narrow_map_names_poles_instead_of_candidates() -> None:
    names = ["k1@3m+0deg", "k1@3m-10deg", "k1@6m+aim"]
    candidates = [ranked_site(name, 5.0, 5.0, 3.0, 9.0 - i, i + 1) for i, name in enumerate(names)]
    grid = Grid((0.0, 0.0, 0.0), 0.5, (20, 20, 4))
    labels = {}
    for width_mm in (85.0, 170.0):
        style = FigureStyle.for_print(width_mm)
        drawn = maps.site_map(grid, np.zeros((20, 20)), EMPTY_BACKDROP, candidates, "", style)
        labels[width_mm] = set(re.findall(r'class="label"[^>]*>([^<]+)<', drawn))
    assert labels == {85.0: {"k1"}, 170.0: {"k1@3m+0deg +2"}}
