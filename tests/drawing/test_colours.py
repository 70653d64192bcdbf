"""Colour scales and the images made with them."""

from __future__ import annotations

import numpy as np

from egvs.drawing import colours
from tests.report.small_runs import decode_png


def test_averages_large_grids():
    field = np.zeros((1300, 700))
    field[:2, :2] = 3.0
    smaller = colours.downsample(field, np.mean)
    assert smaller.shape == (650, 350) and smaller[0, 0] == 3.0 and smaller.sum() == 3.0


NAN = float("nan")


def test_shares_have_a_linear_scale_and_nan_is_transparent() -> None:
    image = decode_png(colours.share_image(np.array([[0.0, NAN], [0.5, 1.0]])).uri(colours.SHARE_PALETTES["day"]))
    assert image.tolist() == [[0, 254], [1, 127]]  # the north first


def luminance(colour: str) -> float:
    """Relative luminance of WCAG 2."""
    parts = []
    for value in bytes.fromhex(colour.lstrip("#")):
        share = value / 255
        parts.append(share / 12.92 if share <= 0.04045 else ((share + 0.055) / 1.055) ** 2.4)
    return 0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2]


def contrast(one: str, other: str) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_shapes_of_dark_maps_have_a_contrast_of_three_to_the_page() -> None:
    dark = colours.DARK
    *rgb, alpha = colours.SHADES["night"]
    paper = bytes.fromhex(dark.halo.lstrip("#"))
    shade = bytes((alpha * a + (255 - alpha) * b) // 255 for a, b in zip(rgb, paper, strict=True)).hex()
    for colour in (dark.large_line, dark.road_edge, shade, *colours.ON_DARK):
        assert contrast(colour, dark.halo) >= 3.0, colour
