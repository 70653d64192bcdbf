"""Names beside spots on a map."""

from __future__ import annotations

import math
import re

from egvs.report import maps
from egvs.report.svg_figures import MapFrame

RADIUS = 9.0


def test_a_line_to_a_name_begins_at_the_edge_of_its_spot() -> None:
    """In the spot stands its rank."""
    plan = MapFrame((0.0, 0.0, 100.0, 80.0), "m")
    row = [(300.0 + 19.0 * number, 250.0, f"a rather long name {number}", RADIUS) for number in range(6)]
    drawn = maps.labels(plan, row)
    lines = [re.match(r'<path class="lead" d="M([\d.]+) ([\d.]+)L', text) for text in drawn if 'class="lead"' in text]
    assert lines
    for line in lines:
        x, y = map(float, line.groups())
        assert min(abs(math.hypot(x - spot[0], y - spot[1]) - RADIUS) for spot in row) < 0.1
