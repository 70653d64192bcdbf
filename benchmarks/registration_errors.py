"""How much scores move when measured empty scans are registered with small errors.

``python -m benchmarks.registration_errors``: the empty scans of nishishinjuku's 13 sites, written as point clouds, take
the place of simulated ones, as after a survey with a tripod or a van. Then each is moved by 5 cm in a random direction
and turned by 0.5 degrees about a random axis through the sensor, with its pose, and scored again. The table states the
changes of the scores relative to the exact scans, over all draws and sites, and how often the best site stays the best.
"""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import kendalltau

import egvs
from egvs.core.files import temporary_folder
from egvs.formats import point_clouds
from egvs.runs import run

SHIFT_M, TURN_DEG = 0.05, 0.5
DRAWS, FRAMES = 10, 1000
SOURCE = Path(__file__).resolve().parent.parent / "scenarios" / "nishishinjuku"


def main() -> None:
    """Print the table."""
    with temporary_folder() as folder:
        scans = _write_scans(folder / "scans")
        exact = _scores(folder / "exact", scans, None)
        rng = np.random.default_rng(1)
        draws = [_scores(folder / f"draw{number}", scans, rng) for number in range(DRAWS)]
    sites = len(exact["egvs"])
    print(f"{sites} sites, {DRAWS} draws: moved by {100 * SHIFT_M:g} cm and turned by {TURN_DEG:g} degrees each")
    for name, values in exact.items():
        moved = np.array([draw[name] for draw in draws])
        change = moved / values - 1.0
        tau = min(kendalltau(row, values).statistic for row in moved)
        same = np.mean(moved.argmax(axis=1) == values.argmax())
        print(
            f"{name}: root mean square {np.sqrt((change**2).mean()):.2%}, largest {np.abs(change).max():.2%}, mean"
            f" {change.mean():+.2%}; Kendall's tau at least {tau:.2f}; best site unchanged in {same:.0%} of draws"
        )


def _write_scans(out: Path) -> dict[str, Path]:
    """Write the empty scan of each site as a point cloud in the world frame; return the file of each site."""
    names = tuple(row["site"] for row in _site_rows())
    options = {"scan": {"points": names, "cloud": "ply"}}
    run.run(egvs.load(SOURCE), out, only=("statics", "scan"), options=options)
    return {name: out / f"scan_{name}.ply" for name in names}


def _site_rows() -> list[dict[str, str]]:
    with (SOURCE / "sites.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _scores(folder: Path, scans: dict[str, Path], rng: np.random.Generator | None) -> dict[str, np.ndarray]:
    """Score measured scans, each moved and turned at random if there is a generator; arrays are by site."""
    shutil.copytree(SOURCE, folder)
    rows = []
    for row in _site_rows():
        points_m, _ = point_clouds.read_points(scans[row["site"]], row["site"])
        sensor_m = np.array([float(row[key]) for key in ("x_m", "y_m", "z_m")])
        if rng is not None:
            axis, direction = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
            turn = Rotation.from_rotvec(np.deg2rad(TURN_DEG) * axis)
            shift_m = SHIFT_M * direction
            points_m = turn.apply(points_m - sensor_m) + sensor_m + shift_m
            sensor_m = sensor_m + shift_m
        name = f"{row['site']}.ply"
        point_clouds.write_points(folder / name, points_m)
        position = dict(zip(("x_m", "y_m", "z_m"), map(repr, sensor_m.tolist()), strict=True))
        rows.append(row | position | {"points": name})
    with (folder / "sites.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    run.run(egvs.load(folder, [f"traffic.frames={FRAMES}"]), folder / "run", only=_STAGES)
    table = egvs.read_scores(folder / "run" / "scores.parquet").to_pandas()
    return {name: table[name].to_numpy() for name in ("egvs", "expected_detections")}


_STAGES = ("statics", "traffic", "tpog", "scan", "score")

if __name__ == "__main__":
    main()
