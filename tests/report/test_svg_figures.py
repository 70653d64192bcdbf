"""Ticks, extents, and figures as files."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import pytest

from egvs.report import svg_figures
from egvs.report.svg_figures import MapSite
from tests.report.small_runs import SITES, PageReader, render_report, run_to_scores


@pytest.mark.parametrize(
    ("low", "high", "texts"),
    [
        (0, 10, ["0", "2", "4", "6", "8", "10"]),
        (389_401, 389_499, ["389,420", "389,440", "389,460", "389,480"]),
        (-0.3, 0.3, ["-0.2", "0.0", "0.2"]),
        (0, 0.05, ["0.00", "0.01", "0.02", "0.03", "0.04", "0.05"]),
        (5, 5, []),
    ],
)
def test_ticks_are_round(low, high, texts):
    assert [text for _, text in svg_figures.round_values(low, high, 5)] == texts


def test_figures_can_be_written_as_files(plain_run):
    for figure in re.findall(r"<svg.*?</svg>", plain_run[2], re.DOTALL):
        root = ET.fromstring(svg_figures.standalone_svg(figure))
        assert root.tag == "{http://www.w3.org/2000/svg}svg"


def test_map_includes_a_distant_site(tmp_path):
    scenario, out = run_to_scores(tmp_path, sites=[*SITES, ("far", 40, 30, 5)])
    x0, y0, x1, y1 = svg_figures.extent(scenario.roi.grid, [MapSite("far", 40, 30, 5, 1.0, 1)])
    assert x0 < 0 and y0 < 0 and x1 > 40 and y1 > 30
    assert "far" in PageReader(render_report(scenario, out)).text
