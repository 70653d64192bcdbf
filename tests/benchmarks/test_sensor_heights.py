"""Sensor heights: the benchmark's scores and detectors are there, and its measurement on few frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks import sensor_heights
from benchmarks.across_junctions import study_detectors


@pytest.mark.system
@pytest.mark.slow
def test_measures_every_detector_at_every_site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensor_heights, "DETECTORS", (study_detectors.SENSOR, "cluster"))
    junction = sensor_heights.measure(tmp_path / "out", 20)
    assert set(junction.scores) == {sensor_heights.MAIN, sensor_heights.FROM_SENSOR, *sensor_heights.EGVS}
    assert all(np.isfinite(values).all() for values in junction.scores.values())
    ap = {name: dict(zip(junction.sites, values.values, strict=True)) for name, values in junction.measures.items()}
    # a sensor 3 m high sees most of a car more than a metre below what the model was trained for
    assert ap[study_detectors.SENSOR]["c10"] < ap["cluster"]["c10"]
    expected = dict(zip(junction.sites, junction.scores[sensor_heights.FROM_SENSOR], strict=True))
    assert expected["c10"] < 0.7 * expected["c01"]
