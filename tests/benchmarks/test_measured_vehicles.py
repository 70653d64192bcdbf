"""The comparison with real vehicles: boxes and counts by hand, and the list in the documentation."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from benchmarks import measured_vehicles
from benchmarks.measured_vehicles import ELSEWHERE, LIST, LOST, ON_VEHICLE, OnVehicle, Vehicle

DOCS = Path(measured_vehicles.__file__).parents[1] / "docs"


def on_vehicle(outcomes: list[int], cosines: list[float], measured: int = 1, simulated: int = 1) -> OnVehicle:
    vehicle = Vehicle(0, 0, "car", np.array([3.0, 4.0, 0.7, 4.5, 1.8, 1.5, 0.0]))
    none = np.empty(0, dtype=np.int64)
    return OnVehicle(
        vehicle, measured, simulated, 0.0, {"paint": none}, {"paint": np.array(outcomes)}, {"paint": np.array(cosines)}
    )


def test_short_side_is_completed_away_from_the_sensor() -> None:
    """A rear end at x = 30 m, 1.8 m wide: a box of 4.5 m from there on, to the right of the sensor."""
    y = np.linspace(-5.0, -3.2, 200)
    z = np.linspace(0.2, 1.4, 200)
    box = measured_vehicles.fit_box(np.column_stack([np.full(200, 30.0), y, z]))
    assert box[[0, 3]] == pytest.approx([32.25, 4.5])
    assert box[[1, 4]] == pytest.approx([-4.1, 1.8], abs=0.03)
    assert box[[2, 5, 6]] == pytest.approx([0.75, 1.5, 0.0])


def test_lost_share_leaves_out_pulses_from_elsewhere() -> None:
    """One of three is lost in all; one of one above 60 degrees."""
    result = on_vehicle([ON_VEHICLE, ON_VEHICLE, LOST, ELSEWHERE], [1.0, 0.9, 0.1, 1.0])
    assert measured_vehicles.lost_share([result], "paint") == pytest.approx(1 / 3)
    assert measured_vehicles.lost_share([result], "paint", 60.0, 90.0) == 1.0
    assert measured_vehicles.elsewhere_share([result], "paint") == 0.25
    assert measured_vehicles.is_dark(result)


def test_jackknife_of_a_mean_is_its_t_interval() -> None:
    """Ratios 1, 2 and 3 of one point each: 2 with a standard error of 1 / sqrt 3, times 4.3027."""
    results = [on_vehicle([], [], 1, simulated) for simulated in (1, 2, 3)]
    share = measured_vehicles.jackknife(results, measured_vehicles.simulated_to_measured)
    assert (share.value, share.high - share.value) == pytest.approx((2.0, 4.30265 / np.sqrt(3)), abs=1e-4)


def test_page_and_counts_agree_with_the_list_of_vehicles() -> None:
    with LIST.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    cars = [row for row in rows if row["kind"] in ("car", "van")]
    measured = sum(int(row["points_measured"]) for row in cars)
    simulated = sum(int(row["points_simulated"]) for row in cars)
    assert len(rows) == sum(map(len, measured_vehicles.CONFIRMED.values())) == 60
    ratio = f"{simulated / measured:.2f}"
    counts = (DOCS / "data" / "measured_vehicles.csv").read_text(encoding="utf-8")
    assert f",all,{len(cars)},{measured},{simulated},{ratio}," in counts
    page = (DOCS / "validity.md").read_text(encoding="utf-8")
    assert f"Cars and vans have [{ratio} (" in page
    assert f"{100 * (simulated / measured - 1):.0f} % more points" in page
