"""Colour scales and the images made with them."""

from __future__ import annotations

import numpy as np

from egvs.report import colours
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
