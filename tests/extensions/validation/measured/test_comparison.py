"""Labelled sweeps beside the simulation.

Evidence: sweeps that are made with known losses, which are recovered; two real sweeps of an installed Ouster OS1-64,
with what was measured on them before (simulated over measured points of cars 2.96 without losses, .92 with them).
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core.errors import InputError
from egvs.core.grid import IntArray
from egvs.effects.registry import make_losses
from egvs.effects.returns import ReturnProbability
from egvs.extensions.validation.measured.comparison import (
    Comparison,
    ComparisonRequest,
    compare_labelled,
    visible_boxes,
)
from egvs.extensions.validation.measured.ratios import ratio_of_sums
from egvs.extensions.validation.measured.return_fit import ReturnFit, fit_returns
from egvs.extensions.validation.measured.tables import fitted_table, sentences
from egvs.scenario.sensor_config import SensorConfig
from egvs.scoring.targets import visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.return_model import ReturnModel
from egvs.sensors.sensor import CATALOGUE
from tests.extensions.validation.measured import twin
from tests.extensions.validation.measured.twin import SENSOR

TUMTRAF = Path(__file__).parents[5] / "shared" / "real" / "tumtraf"

DEFAULT = ReturnModel.of(CATALOGUE[SENSOR])
CARS_AT_M = (25.0, 33.0, 42.0, 55.0)

LOSSES = replace(DEFAULT, rated_range_m=75.0, softness=0.8)
"""The losses of the twin; the sensor of the catalogue has other ones."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, twin.Twin]:
    """Sweeps and labels in one folder."""
    folder = tmp_path_factory.mktemp("twin")
    sweeps = twin.make_twin(LOSSES, seed=1)
    twin.write_pcd(folder, sweeps)
    twin.write_openlabel(folder, sweeps)
    return folder, sweeps


@pytest.fixture(scope="module")
def compared(made: tuple[Path, twin.Twin]) -> Comparison:
    """The twin, compared with the sensor of the catalogue."""
    folder, _ = made
    return compare_labelled(ComparisonRequest((folder,), (folder,), SENSOR))


@pytest.mark.slow
def test_known_losses_are_within_the_printed_interval(compared: Comparison) -> None:
    fit = compared.fit
    assert fit is not None and fit.objects == 60
    low_m, high_m = fit.limit_interval_m
    assert low_m < LOSSES.limit_m(0.03) < high_m < 1.2 * low_m
    low, high = fit.softness_interval
    assert low < LOSSES.softness < high < low + 1.0
    assert fit.rated_range_m == pytest.approx(LOSSES.rated_range_m, rel=0.1)


@pytest.mark.slow
def test_intervals_contain_known_losses(tmp_path: Path) -> None:
    """Of ten twins of 40 cars, two standard errors contain the limit and the softness of at least eight."""
    limits = softnesses = 0
    for seed in range(10, 20):
        folder = tmp_path / str(seed)
        folder.mkdir()
        sweeps = twin.make_twin(LOSSES, seed, sweeps=2)
        labels = tuple(twin.write_openlabel(folder, sweeps))
        fit = compare_labelled(ComparisonRequest(tuple(twin.write_pcd(folder, sweeps)), labels, SENSOR)).fit
        assert fit is not None and 0.0 < fit.limit_se < 0.03
        low_m, high_m = fit.limit_interval_m
        limits += low_m < LOSSES.limit_m(0.03) < high_m
        low, high = fit.softness_interval
        softnesses += low < LOSSES.softness < high
    assert limits >= 8 and softnesses >= 8


def test_points_by_range(compared: Comparison) -> None:
    cars, *by_range = compared.rows
    assert (cars.label, cars.boxes, cars.objects) == ("car", 60, 60)
    assert sum(row.boxes for row in by_range) == 60 and sum(row.measured for row in by_range) == cars.measured
    near, far = by_range[0].without_losses, by_range[-1].without_losses
    assert 1.0 < near.value < 1.2 and far.value > 1.5  # losses rise with the range
    assert cars.with_losses.value < 0.95  # the catalogue's sensor loses more than this one


@pytest.mark.slow
def test_without_losses_simulation_and_sweeps_agree(tmp_path: Path) -> None:
    sweeps = twin.make_twin(None, seed=2)
    request = ComparisonRequest(
        tuple(twin.write_pcd(tmp_path, sweeps)), tuple(twin.write_openlabel(tmp_path, sweeps)), SENSOR
    )
    row = compare_labelled(request).rows[0]
    assert row.without_losses.value == pytest.approx(1.0, abs=0.03)


def test_fitted_sensor_is_a_sensor(compared: Comparison) -> None:
    import tomllib

    text = fitted_table(compared)
    (values,) = tomllib.loads(text)["sensors"].values()
    config = SensorConfig.from_dict(values)
    assert compared.fit is not None
    assert config.rated_range_m == pytest.approx(compared.fit.rated_range_m, abs=0.05)
    assert config.rings == 64 and config.azimuths == 2048


def test_levels_have_both_numbers(compared: Comparison) -> None:
    cars, *by_range = compared.levels
    assert cars.from_m is None and sum(row.boxes for row in by_range) == cars.boxes == 60
    assert cars.detectors["sensor"].value < cars.detectors["fitted"].value < cars.detectors["none"].value
    assert cars.people["sensor"].value < cars.people["none"].value
    assert 0.0 < cars.people["measured"].value < 1.0


def test_boxes_are_seen_as_in_a_run_with_the_same_sensor(compared: Comparison) -> None:
    """With losses, points reach less far over a vehicle, and the stretches without points are longer."""
    site, count = compared.site, len(CARS_AT_M)
    boxes = np.array([(x, 0.5, 0.75, *twin.CAR_M, 0.4) for x in CARS_AT_M])
    frame = TrafficFrame(0, tuple("abcd"), ("passenger",) * count, boxes, np.zeros(count))
    there, without = (visible_boxes(site, [frame], model) for model in (compared.model, None))
    beams = Beams(site.pose, site.sensor, site.range_m[:, None] * site.directions)
    scored = visible_targets(there.record, beams, ReturnProbability((make_losses(),), site.sensor))
    for name in ("points", "points_alone", "length_share", "width_share", "hole_m"):
        np.testing.assert_array_equal(getattr(there, name), getattr(scored, name), err_msg=name)
    far = slice(1, None)  # the first has so many points that none of its extent is lost
    assert (there.length_share < without.length_share)[far].all() and (there.hole_m > without.hole_m)[far].all()


@pytest.mark.slow
def test_returns_that_no_range_loses_have_no_fit() -> None:
    """If all beams return, more than the dropout lets, the best limit is the last that is tried: no estimate."""
    rng, per_car = np.random.default_rng(1), 200
    owner = np.repeat(np.arange(10), per_car)
    range_m, weight = rng.uniform(15.0, 60.0, len(owner)), np.ones(len(owner))

    def fit(measured: IntArray) -> ReturnFit | None:
        return fit_returns(measured, owner, range_m, weight, np.arange(10), DEFAULT)

    assert fit(np.full(10, per_car)) is None
    with_losses = fit(np.bincount(owner, DEFAULT.probability(range_m, 0.03)).round().astype(np.int64))
    assert with_losses is not None and with_losses.limit_m == pytest.approx(DEFAULT.limit_m(0.03), rel=0.02)


@pytest.mark.slow
def test_comparison_says_that_the_limit_is_beyond_what_is_tried(tmp_path: Path) -> None:
    sweeps = twin.make_twin(None, seed=3, sweeps=1, cars=8)
    comparison = write_and_compare(tmp_path, twin.write_openlabel(tmp_path, sweeps), sweeps)
    assert comparison.fit is None
    assert any("beyond the tried 4 to 600 m" in note for note in comparison.notes)


def write_and_compare(folder: Path, labels: list[Path], sweeps: twin.Twin, **options: object) -> Comparison:
    request = ComparisonRequest(tuple(twin.write_pcd(folder, sweeps)), tuple(labels), SENSOR, **options)  # type: ignore[arg-type]
    return compare_labelled(request)


@pytest.mark.slow
@pytest.mark.parametrize("write", [twin.write_kitti, twin.write_dair])
def test_formats_of_labels_agree(
    tmp_path: Path, made: tuple[Path, twin.Twin], compared: Comparison, write: object
) -> None:
    _, sweeps = made
    other = write_and_compare(tmp_path, write(tmp_path, sweeps), sweeps)  # type: ignore[operator]
    assert np.abs(other.points.measured - compared.points.measured).max() <= 1  # KITTI has six digits
    assert (other.convention is None) == (write is twin.write_kitti)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sign", "from_rad"),
    [("x-ccw", 1, 0.0), ("x-cw", -1, 0.0), ("y-ccw", 1, math.pi / 2), ("y-cw", -1, math.pi / 2)],
)
def test_conventions_of_headings_are_found(
    tmp_path: Path, made: tuple[Path, twin.Twin], compared: Comparison, name: str, sign: float, from_rad: float
) -> None:
    _, sweeps = made
    table = twin.write_table(tmp_path / "labels.csv", sweeps, sign, from_rad)
    other = write_and_compare(tmp_path, [table], sweeps, columns={"type": "class", "x_m": "cx"})
    assert other.convention is not None and other.convention[0] == name
    assert len(other.convention[1]) == 4
    assert other.points.measured.tolist() == compared.points.measured.tolist()
    assert any(f"Headings are taken as {name}" in sentence for sentence in sentences(other))


@pytest.mark.slow
def test_unclear_headings_are_refused(tmp_path: Path, made: tuple[Path, twin.Twin]) -> None:
    _, sweeps = made
    turned = twin.Twin(sweeps.points_m, [boxes.copy() for boxes in sweeps.boxes])
    rng = np.random.default_rng(3)
    for boxes in turned.boxes:
        boxes[:, 6] = rng.uniform(-math.pi, math.pi, len(boxes))
    table = twin.write_table(tmp_path / "labels.csv", turned)
    with pytest.raises(InputError, match=r"labels\.csv: the convention of headings is not clear.*--yaw"):
        write_and_compare(tmp_path, [table], turned, columns={"type": "class", "x_m": "cx"})
    stated = write_and_compare(tmp_path, [table], turned, columns={"type": "class", "x_m": "cx"}, yaw="x-ccw")
    assert stated.convention is None


@pytest.mark.slow
def test_conventions_with_the_same_boxes_count_as_one(tmp_path: Path, made: tuple[Path, twin.Twin]) -> None:
    _, sweeps = made
    along = twin.Twin(sweeps.points_m, [boxes.copy() for boxes in sweeps.boxes])
    for boxes in along.boxes:
        boxes[:, 3:5], boxes[:, 6] = 4.0, 0.0  # squares, headed along x
    table = twin.write_table(tmp_path / "labels.csv", along)
    with pytest.raises(InputError, match=r"by convention: x-ccw [\d,]+, y-ccw [\d,]+\."):
        write_and_compare(tmp_path, [table], along, columns={"type": "class", "x_m": "cx"})


def test_labels_of_other_sweeps_are_refused(tmp_path: Path, made: tuple[Path, twin.Twin]) -> None:
    _, sweeps = made
    labels = twin.write_openlabel(tmp_path, sweeps)
    renamed = [path.rename(path.with_name(f"other{path.name}")) for path in labels]
    with pytest.raises(InputError, match="expected labels of these sweeps"):
        write_and_compare(tmp_path, renamed, sweeps)


def test_damaged_labels_of_a_folder_are_named(tmp_path: Path, made: tuple[Path, twin.Twin]) -> None:
    """Their content is of no format; other files beside the labels do not count."""
    _, sweeps = made
    folder = tmp_path / "labels"
    folder.mkdir()
    damaged, *_ = twin.write_openlabel(folder, sweeps)
    (folder / "calibration.json").write_text("{}")
    damaged.write_text("1_000")
    with pytest.raises(InputError, match=rf"{damaged.name}: expected labels .*got another or a damaged file"):
        write_and_compare(tmp_path, [folder], sweeps)


def test_ratio_and_error_by_hand() -> None:
    """Six objects of one box each: the jackknife of a ratio of sums."""
    above, below = np.array([2.0, 4, 6, 8, 10, 12]), np.array([1, 2, 3, 4, 5, 5])
    ratio = ratio_of_sums(above, below, np.arange(6))
    assert ratio.value == pytest.approx(42 / 20)
    left_out = (42 - above) / (20 - below)
    assert ratio.se == pytest.approx(math.sqrt(5 / 6 * ((left_out - left_out.mean()) ** 2).sum()))
    assert math.isnan(ratio_of_sums(above, below, np.array([0, 0, 1, 1, 2, 2])).se)  # three objects


@pytest.mark.slow
def test_real_sweeps_of_an_ouster() -> None:
    """The losses of the catalogue were fitted with these sweeps, so this is no test of them."""
    if not TUMTRAF.is_dir():
        pytest.skip("shared/real/tumtraf is not beside the checkout")
    result = compare_labelled(ComparisonRequest((TUMTRAF,), (TUMTRAF,), SENSOR))
    cars = result.rows[0]
    assert (cars.label, cars.boxes, cars.objects, len(result.points)) == ("car", 23, 13, 32)
    assert cars.without_losses.value == pytest.approx(2.96, abs=0.1)
    assert cars.with_losses.value == pytest.approx(0.92, abs=0.05)
    by_range = {row.from_m: row.without_losses.value for row in result.rows if row.label == "car"}
    assert by_range[30] == pytest.approx(2.78, abs=0.1) and by_range[40] == pytest.approx(3.67, abs=0.2)
    trucks = next(row for row in result.rows if row.label == "truck")
    assert trucks.with_losses.value == pytest.approx(2.1, abs=0.2)
    assert result.fit is not None and result.fit.limit_m == pytest.approx(30.3, abs=2 * 1.7)
    assert any("an anchor, not a validation" in note for note in result.notes)
