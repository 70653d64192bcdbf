"""Models of detectors and curves of people beside the published recall of four real LiDARs on a straight road.

``python -m benchmarks.straight_road`` writes ``docs/data/straight_road.csv`` and ``docs/images/straight-road.png``, and
prints the table. MR-LiDAR (arXiv 2605.24777) recorded one straight road with sensors of 16, 32, 80 and 128 beams, 1.5 m
above it, and published the recall of cars of CenterPoint and SECOND by range. Here, sensors with as many beams stand at
the same height beside a level road with two lanes; a car stands at each :data:`SPACING_M` of either lane, alone, so
that nothing occludes it. The table has the means over these cars of what the models of the installed detectors expect,
and of what people would notice, from points with losses of returns.

It is a test: nothing is fitted to it. The units of the data set are not known to us, so sensors of the catalogue stand
in for them; nor do we know when a box counted there. On the real road, cars hid one another.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from egvs.core.grid import FloatArray, Grid
from egvs.effects.range_limit import RangeLimit
from egvs.effects.returns import ReturnProbability
from egvs.scenario.effects_config import RangeLimitParameters
from egvs.scoring.noticed import noticed_chances
from egvs.scoring.target_scores import DETECTORS, chances_by_detector
from egvs.scoring.targets import TargetRecord, TargetVisibility, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.sensor import Sensor, resolve_sensor
from egvs.sensors.sites import Pose

ROOT = Path(__file__).parents[1]
TABLE, FIGURE = ROOT / "docs" / "data" / "straight_road.csv", ROOT / "docs" / "images" / "straight-road.png"

HEIGHT_M = 1.5
LANES_M = (4.0, 7.5)
"""Distance of the middle of each lane from the sensor."""

SPACING_M = 0.5
CAR_M = (4.5, 1.8, 1.5)
RANGES_M = ((0, 20), (20, 40), (40, 60), (60, 80))

STAND_INS = {16: "VLP-16", 32: "VLP-32C", 80: "RS-Ruby 80", 128: "RS-Ruby Plus"}

CENTERPOINT, SECOND = "CenterPoint", "SECOND"
PUBLISHED: dict[int, dict[str, tuple[float | None, ...]]] = {
    128: {CENTERPOINT: (0.90, 0.90, 1.00, 0.99), SECOND: (0.90, 0.91, 1.00, 0.97)},
    80: {CENTERPOINT: (0.88, 0.90, 0.93, 0.90), SECOND: (0.93, 0.95, 0.98, 0.89)},
    32: {CENTERPOINT: (0.87, 0.79, 0.67, None), SECOND: (0.89, 0.83, 0.83, None)},
    16: {CENTERPOINT: (0.89, 0.17, None, None), SECOND: (0.85, 0.05, None, None)},
}
"""Recall of cars by range in MR-LiDAR; None where none is published."""


class Row(NamedTuple):
    """One sensor and range: published recall, and means over the cars of this benchmark."""

    beams: int
    sensor: str
    from_m: int
    to_m: int
    points: float
    detectors: tuple[float, ...]
    noticed: float
    centerpoint: float | None
    second: float | None


def stand_in(beams: int) -> Sensor:
    """Return the sensor that stands in for the one with as many beams."""
    return resolve_sensor(STAND_INS[beams], {}, "straight_road")


def cars() -> TargetRecord:
    """Return cars on both lanes, each alone in a frame of its own."""
    along_m = np.arange(-RANGES_M[-1][1], RANGES_M[-1][1] + SPACING_M, SPACING_M)
    boxes = [(x, y, 0.5 * CAR_M[2], *CAR_M, 0.0) for y in LANES_M for x in along_m]
    far_m = RANGES_M[-1][1] + 10
    grid = Grid((-far_m, -20.0, 0.0), 1.0, (2 * far_m, 40, 5))
    return TargetRecord.alone(np.array(boxes), "passenger", grid)


def road_beams(sensor: Sensor) -> Beams:
    """Return the beams of a sensor above a level road without anything on it."""
    directions = sensor.directions()
    down = directions[:, 2] < 0.0
    length_m = np.full(len(directions), float(sensor.range_m))
    length_m[down] = np.minimum(length_m[down], -HEIGHT_M / directions[down, 2])
    return Beams(Pose(0.0, 0.0, HEIGHT_M), sensor, length_m[:, None] * directions)


def view_of_road(sensor: Sensor, record: TargetRecord) -> TargetVisibility:
    """Return what a sensor sees of each car, with losses of returns."""
    losses = ReturnProbability((RangeLimit(RangeLimitParameters()),), sensor)
    return visible_targets(record, road_beams(sensor), losses)


def rows(sensors: Sequence[int] = tuple(sorted(PUBLISHED))) -> list[Row]:
    """Return the table, for sensors with these numbers of beams."""
    record = cars()
    table = []
    for beams in sensors:
        sensor = stand_in(beams)
        visible = view_of_road(sensor, record)
        by_detector, noticed = chances_by_detector(visible, DETECTORS), noticed_chances(visible)
        for number, (from_m, to_m) in enumerate(RANGES_M):
            within = (visible.range_m >= from_m) & (visible.range_m < to_m)
            published = [PUBLISHED[beams][name][number] for name in (CENTERPOINT, SECOND)]
            detectors = tuple(by_detector[:, within].mean(axis=1).tolist())
            points = float(visible.points[within].mean())
            table.append(
                Row(beams, sensor.name, from_m, to_m, points, detectors, float(noticed[within].mean()), *published)
            )
    return table


def write_table(path: Path, table: Sequence[Row]) -> None:
    """Write the table as CSV."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        heads = ["beams", "stand_in", "from_m", "to_m", "points", *DETECTORS, "noticed"]
        writer.writerow([*heads, "published_centerpoint", "published_second"])
        for row in table:
            shares = [f"{share:.3f}" for share in (*row.detectors, row.noticed)]
            published = ["" if share is None else f"{share:.2f}" for share in (row.centerpoint, row.second)]
            writer.writerow([row.beams, row.sensor, row.from_m, row.to_m, f"{row.points:.1f}", *shares, *published])


def print_table(table: Sequence[Row]) -> None:
    """Print the table in Markdown, in per cent."""
    heads = ["beams", "range m", "points", *DETECTORS, "noticed", f"published {CENTERPOINT}", f"published {SECOND}"]
    print(f"| {' | '.join(heads)} |")
    print("|---:" * len(heads) + "|")
    for row in table:
        shares = [*row.detectors, row.noticed, row.centerpoint, row.second]
        cells = ["-" if share is None else f"{100.0 * share:.0f}" for share in shares]
        print(f"| {row.beams} | {row.from_m}-{row.to_m} | {row.points:.0f} | {' | '.join(cells)} |")


def draw_figure(path: Path, table: Sequence[Row]) -> None:
    """Draw a panel for each sensor: shares by range."""
    figure = Figure(figsize=(11.0, 3.2), layout="constrained")
    panels = figure.subplots(1, len(PUBLISHED), sharey=True)
    for panel, beams in zip(panels, sorted(PUBLISHED), strict=True):
        of_sensor = [row for row in table if row.beams == beams]
        middle_m = [0.5 * (row.from_m + row.to_m) for row in of_sensor]
        for name, style in ((CENTERPOINT, "ks-"), (SECOND, "kD--")):
            shares = PUBLISHED[beams][name]
            panel.plot(middle_m, _percent(shares), style, label=f"{name}, published", markersize=4)
        for number, name in enumerate(DETECTORS):
            panel.plot(
                middle_m, _percent([row.detectors[number] for row in of_sensor]), "o-", label=f"{name}, expected"
            )
        panel.plot(middle_m, _percent([row.noticed for row in of_sensor]), "^-", label="people, noticed")
        panel.set(title=f"{beams} beams", xlabel="range (m)", xlim=(0, RANGES_M[-1][1]), ylim=(0, 103))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("share of cars (%)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize="small")
    figure.savefig(path, dpi=100, metadata={"Software": None})


def _percent(shares: Sequence[float | None]) -> FloatArray:
    return np.array([np.nan if share is None else 100.0 * share for share in shares])


def main() -> None:
    """Write the table and the figure, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.straight_road", description=__doc__.split("\n")[0])
    parser.add_argument("--table", type=Path, default=TABLE, help="CSV file to write")
    parser.add_argument("--figure", type=Path, default=FIGURE, help="PNG file to write")
    given = parser.parse_args()
    table = rows()
    write_table(given.table, table)
    draw_figure(given.figure, table)
    print_table(table)


if __name__ == "__main__":
    main()
