"""Detectors on measured and on simulated sweeps of the same boxes.

Evidence: a detector that returns boxes that are known; sweeps that are made by the simulation, on which ``cluster``
finds as many vehicles as in the simulation.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egvs.clouds.sweeps import Detections, Sweep
from egvs.extensions.validation.measured.comparison import ComparisonRequest, compare_labelled
from egvs.extensions.validation.measured.detection import area_under_curve, find_boxes
from egvs.sensors.return_model import ReturnModel
from egvs.sensors.sensor import CATALOGUE
from tests.extensions.validation.measured import twin
from tests.extensions.validation.measured.twin import SENSOR

CAR = [10.0, 5.0, 0.8, 4.5, 1.8, 1.6, 0.3]
EMPTY = Sweep(np.empty((0, 4), np.float32), np.empty(0, np.uint32))


@pytest.mark.parametrize(
    ("shift_m", "fits", "nearby"), [(0.0, True, True), (0.2, True, True), (1.2, False, True), (1.6, False, False)]
)
def test_found_by_overlap_and_by_distance(shift_m: float, fits: bool, nearby: bool) -> None:
    labelled = np.array([CAR, [60.0, *CAR[1:]]])
    detected = labelled[:1].copy()
    detected[0, :2] += shift_m * np.array([np.cos(CAR[6]), np.sin(CAR[6])])
    found = find_boxes(lambda _: Detections(detected, np.ones(1)), [EMPTY], [labelled])
    assert found.fits.tolist() == [fits, False] and found.nearby.tolist() == [nearby, False]


def test_no_detections_find_nothing() -> None:
    found = find_boxes(lambda _: Detections.empty(), [EMPTY, EMPTY], [np.array([CAR]), np.empty((0, 7))])
    assert found.fits.tolist() == [False] and found.nearby.tolist() == [False]


def test_area_under_curve_by_hand() -> None:
    values, found = np.array([0.1, 0.2, 0.3, 0.4, 0.5] * 2), np.array([False] * 5 + [True] * 5)
    assert area_under_curve(values, found) == pytest.approx(0.5)
    assert area_under_curve(np.append(values[:5], values[5:] + 1.0), found) == 1.0
    assert np.isnan(area_under_curve(values[1:], found[1:]))


@pytest.mark.slow
def test_simulated_copy_is_found_as_the_simulation(tmp_path: Path) -> None:
    pytest.importorskip("sklearn")
    sweeps = twin.make_twin(ReturnModel.of(CATALOGUE[SENSOR]), seed=4)
    labels = tuple(twin.write_openlabel(tmp_path, sweeps))
    request = ComparisonRequest(tuple(twin.write_pcd(tmp_path, sweeps)), labels, SENSOR, detectors=("cluster",))
    row, *by_range = compare_labelled(request).detections
    assert sum(other.boxes for other in by_range) == row.boxes == 60
    assert (row.detector, row.group, row.boxes, row.objects) == ("cluster", "cars", 60, 60)
    assert row.expected is not None and 0.2 < row.expected.value < 0.95
    assert row.measured.value == pytest.approx(row.simulated.value, abs=0.15)
    assert row.measured_nearby.value >= row.measured.value > 0.3
    assert row.auc > 0.6 and len(row.bins) == 4
    assert [expected for expected, _ in row.bins] == sorted(expected for expected, _ in row.bins)
