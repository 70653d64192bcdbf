"""Ticks, extents, and figures as files."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import pytest

from egvs.drawing import svg_figures
from egvs.drawing.svg_figures import Bar, CurveStep, FigureStyle, sensor_count_chart
from tests.report.small_runs import SITES, PageReader, ranked_site, render_report, run_to_scores


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
    x0, y0, x1, y1 = svg_figures.extent(scenario.roi.grid, [ranked_site("far", 40, 30, 5, 1.0, 1)])
    assert x0 < 0 and y0 < 0 and x1 > 40 and y1 > 30
    assert "far" in PageReader(render_report(scenario, out)).text


# --- lettering at the width of a column ----------------------------------------------------------------------------
NAMES = ["k07@4.5m-10deg", "k12@6m+aim", "MMMMMMMMMMMMMMMMMM", "", "pole 1, north", "Entropy (bit) · scale"]


def true_width(text: str) -> float:
    """Width of a text in DejaVu Sans of 12 units."""
    text_path = pytest.importorskip("matplotlib.textpath", reason="matplotlib is not installed")
    font = pytest.importorskip("matplotlib.font_manager").FontProperties(family="DejaVu Sans", size=12)
    return float(text_path.TextToPath().get_text_width_height_descent(text, font, ismath=False)[0])


@pytest.mark.parametrize("text", NAMES)
def test_estimated_width_is_not_less_than_that_of_the_widest_font(text: str) -> None:
    assert true_width(text) <= svg_figures.text_width(text) <= 1.5 * true_width(text)


def spans(svg: str) -> list[tuple[str, float, float]]:
    """Each upright text of a figure with its left and right end."""
    found = []
    for text in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text"):
        if text.get("transform") is None:
            share = {"middle": 0.5, "end": 1.0}.get(text.get("text-anchor", ""), 0.0)
            left = float(text.get("x")) - share * true_width(text.text)
            found.append((text.text, left, left + true_width(text.text)))
    return found


def test_no_label_is_clipped_at_85_mm() -> None:
    style = FigureStyle.for_print(85.0)
    bars = [Bar(name, 0.9, 0.01, "") for name in NAMES[:3]]
    chart = svg_figures.bar_chart(bars, "the share of vehicles found (%)", "", 100.0, style)

    frame = svg_figures.MapFrame((5810.0, 4000.0, 5880.0, 4070.0), "m", style.width, 560.0, north=True, style=style)
    bar = svg_figures.ColourBar(0.0, 2.5, "Entropy in the column that k02@3m-10deg misses (bit)")
    view = frame.svg([], "", bar)
    for figure in (chart, view):
        for text, left, right in spans(figure):
            assert left >= 0.0 and right <= style.width, text
    titles = [text for text, _, _ in spans(view)]
    assert titles[-2:] == ["Entropy in the column that k02@3m-10deg misses (bit)", "square-root scale"]
    height = float(ET.fromstring(view).get("viewBox").split()[3])
    assert height > frame.top + frame.frame_height + 40.0 + 56.0, "a second line of the title needs its room"


def test_title_of_a_wide_colour_bar_is_one_line() -> None:
    bar = svg_figures.ColourBar(0.0, 2.5, "Entropy (bit)")
    assert bar.title_lines(700.0) == ["Entropy (bit) · square-root scale"]
    assert svg_figures.ColourBar(0.0, 1.0, "Share", even=True).title_lines(700.0) == ["Share"]


def bar_lengths(figure: str) -> list[float]:
    return [float(length) for length in re.findall(r'<rect [^>]*height="([0-9.]+)"', figure)]


def test_axis_of_long_bars_starts_above_zero_and_says_so() -> None:
    figure = sensor_count_chart([CurveStep(1, 0.96, 0.96), CurveStep(2, 0.998, 1.0)], "alt")
    shorter, longer = bar_lengths(figure)
    assert shorter < 0.5 * longer
    assert "the axis starts at 94 %, not at 0" in figure


def test_axis_of_equal_full_bars_starts_at_most_at_95_per_cent() -> None:
    figure = sensor_count_chart([CurveStep(1, 1.0, 1.0)], "alt")
    assert "the axis starts at 95 %, not at 0" in figure and bar_lengths(figure)[0] > 100


def test_axis_of_short_bars_starts_at_zero() -> None:
    figure = sensor_count_chart([CurveStep(1, 0.4, 0.5), CurveStep(2, 0.8, 0.9)], "alt")
    shorter, longer = bar_lengths(figure)
    assert abs(longer - 2 * shorter) < 0.2 and "starts at" not in figure
