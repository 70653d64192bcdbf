"""A small city of two junctions, whose traffic is a finished file: two cars on one road, and a bus that turns."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from egvs.city.model import City, load_city
from tests.conftest import SCENARIO, SITES, collection, write_mini

FRAMES = 60
WEST, EAST = (20.0, 0.0), (520.0, 0.0)
"""The middles of the two junctions' regions."""

CITY = """\
seed = 7

[traffic]
fcd = "fcd.csv"
frames = 60
frame_period_s = 0.5

[[traffic.kinds]]
name = "car"
length_m = 4.5
width_m = 1.8
height_m = 1.5

[[traffic.kinds]]
name = "bus"
vclass = "bus"
length_m = 18.0
width_m = 2.5
height_m = 3.0
"""


def fcd() -> str:
    """Cars go from west to east, the bus circles far from both junctions before it comes through the western one; the
    eastern one is empty in the first frames and in the last."""
    lines = ["timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type;vehicle_speed"]
    for frame in range(FRAMES):
        t = 0.5 * frame
        x, turn = -300 + 11 * t, 0.2 * t
        lines.append(f"{t:.2f};bus;{x:.6f};{1 + 20 * math.sin(turn):.6f};{90 - 30 * math.cos(turn):.6f};bus;11.0")
        lines.append(f"{t:.2f};car;{10 + 2 * t:.6f};-2.0;90.0;car;2.0")
        lines.append(f"{t:.2f};far;{1150 - 50 * t:.6f};{2 + 0.5 * math.sin(t):.6f};{270 - 5 * math.cos(t):.6f};car;50")
    return "\n".join(lines) + "\n"


def write_city(folder: Path) -> Path:
    """The city's folder: two junctions alike, 500 m apart."""
    folder.mkdir(parents=True)
    (folder / "city.toml").write_text(CITY)
    (folder / "fcd.csv").write_text(fcd())
    rows = ["junction,title,x_m,y_m,lat_deg,lon_deg,signalised"]
    for name, (x, y) in (("west", WEST), ("east", EAST)):
        rows.append(f"{name},the one in the {name},{x},{y},50.0,9.0,true")
        write_junction(folder / "junctions" / name, name, x - WEST[0])
    (folder / "junctions.csv").write_text("\n".join([*rows, ""]))
    return folder


def write_junction(folder: Path, name: str, east_m: float) -> None:
    """A scenario like the small one of all tests, so far to the east, with the city's traffic."""
    folder.parent.mkdir(exist_ok=True)
    write_mini(folder)
    (folder / "fcd.csv").unlink()
    text = SCENARIO.replace("center_m = [20,", f"center_m = [{20 + east_m:g},")
    text = re.sub(r'fcd = .*?\n(?=\[statics)', f'fcd = "../../traffic/{name}.parquet"\nframe_period_s = 0.5\n\n',
                  text, flags=re.DOTALL)  # fmt: skip
    (folder / "scenario.toml").write_text(text)
    head, *sites = SITES.splitlines()
    moved = (row.split(",") for row in sites)
    rows = [f"{site},{float(x) + east_m},{y},{z}" for site, x, y, z in moved]
    (folder / "sites.csv").write_text("\n".join([head, *rows, ""]))
    (folder / "statics.geojson").write_text(collection())


@pytest.fixture
def city(tmp_path: Path) -> City:
    """The small city, read."""
    return load_city(write_city(tmp_path / "town"))
