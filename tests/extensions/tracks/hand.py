"""What tests of readers with rows by hand share."""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.extensions.tracks.model import Tracks

REAL = Path(__file__).parents[4] / "shared" / "real"
"""Recorded tracks of other people, beside the checkout on some machines only."""

needs_karlsruhe = pytest.mark.skipif(
    not (REAL / "karlsruhe_k733").is_dir(), reason="karlsruhe_k733 is not beside the checkout (shared/real)"
)
needs_sind = pytest.mark.skipif(not (REAL / "sind").is_dir(), reason="sind is not beside the checkout (shared/real)")

Box = tuple[str, str, float, float, float, float, float, float, float, float]
"""Name, class, time, x, y, z, yaw, length, width, height; NaN if unknown."""


def box_list(tracks: Tracks) -> list[Box]:
    """Return the boxes of tracks, in the order of the file, numbers rounded to 4 digits."""
    columns = ("time_s", "x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    numbers = np.column_stack([getattr(tracks, key) for key in columns]).round(4)
    return [(tracks.names[t], tracks.classes[t], *row) for t, row in zip(tracks.track, numbers.tolist(), strict=True)]


def assert_boxes(tracks: Tracks, expected: list[Box]) -> None:
    """Assert boxes to 0.0001; NaN equals NaN."""
    assert repr(box_list(tracks)) == repr([(*box[:2], *(float(number) for number in box[2:])) for box in expected])


def assert_one_message(read: Callable[[], object], expected: str) -> None:
    """Assert that reading fails with one message of one line, that contains the text and says what to do."""
    with pytest.raises(InputError, match=re.escape(expected)) as caught:
        read()
    assert "\n" not in str(caught.value)
    assert caught.value.hint


def truncated_gzip(path: Path) -> Path:
    """Write the first half of a gzipped copy beside a file."""
    packed = gzip.compress(path.read_bytes())
    copy = path.with_name(f"{path.name}.gz")
    copy.write_bytes(packed[: len(packed) // 2])
    return copy
