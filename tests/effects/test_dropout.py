"""Dropout."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.effects.detect_helpers import hits_along_beam


def test_dropout_equals_hand_computed_hits(one_beam_run: tuple[Path, Path]) -> None:
    np.testing.assert_array_equal(hits_along_beam(one_beam_run, "effects.dropout.share=0.25"), 0.75)
