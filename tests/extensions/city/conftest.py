"""A small city, a cluster in this process, and jobs of small junctions.

The city has two junctions and a finished file of traffic: two cars on one road, and a bus that turns.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import egvs
from egvs.artefacts.run_folder import STAGE_NAMES
from egvs.artefacts.run_record import RunRecord
from egvs.extensions.city import scheduler
from egvs.extensions.city.model import City, load_city
from egvs.extensions.city.tasks import Job
from egvs.runs import run
from tests.conftest import SCENARIO, SITES, collection, write_mini
from tests.extensions.city.real_cluster import RealCluster

FRAMES = 60
OVERRIDES = ("scan.keep=false", 'score.keep_visibility="all"', 'score.others=["seen_well", "coverage"]')
"""With these, scores of a site have all kinds of arrays."""

WEST, EAST = (20.0, 0.0), (520.0, 0.0)
"""Centres of the two regions of interest."""

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
    """Return the traffic: cars along the road, and a bus that turns before it passes the western junction.

    The eastern junction is empty in the first and in the last frames.
    """
    lines = ["timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type;vehicle_speed"]
    for frame in range(FRAMES):
        t = 0.5 * frame
        x, turn = -300 + 11 * t, 0.2 * t
        lines.append(f"{t:.2f};bus;{x:.6f};{1 + 20 * math.sin(turn):.6f};{90 - 30 * math.cos(turn):.6f};bus;11.0")
        lines.append(f"{t:.2f};car;{10 + 2 * t:.6f};-2.0;90.0;car;2.0")
        lines.append(f"{t:.2f};far;{1150 - 50 * t:.6f};{2 + 0.5 * math.sin(t):.6f};{270 - 5 * math.cos(t):.6f};car;50")
    return "\n".join(lines) + "\n"


def write_city(folder: Path) -> Path:
    """Write the folder of a city with two equal junctions, 500 m apart."""
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
    """Write the small scenario of all tests, moved to the east, with the city's traffic."""
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
    """The small city."""
    return load_city(write_city(tmp_path / "town"))


@pytest.fixture(scope="session")
def client() -> Iterator[Any]:
    """A client of two workers in this process, which behave as in processes of their own, but cannot be killed."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0") as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


@pytest.fixture
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RealCluster]:
    """A scheduler without workers."""
    started = RealCluster(tmp_path_factory.mktemp("cluster"))
    yield started
    started.close()


@pytest.fixture
def in_process_cluster(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make city runs use the cluster of this process."""

    @contextmanager
    def connect(_cluster: str) -> Iterator[Any]:
        yield client

    monkeypatch.setattr(scheduler, "connect", connect)


@pytest.fixture
def jobs(tmp_path: Path) -> list[Job]:
    """Jobs of three small junctions, with two, three and four poles."""
    jobs = []
    for number, name in enumerate(("a", "b", "c")):
        folder = write_mini(tmp_path / name)
        more = "".join(f"pole_{i},{12 + i}.25,-11,3.5\n" for i in range(number))
        (folder / "sites.csv").write_text((folder / "sites.csv").read_text() + more)
        jobs.append(Job(name, folder, tmp_path / "out" / name))
    return jobs


def run_separately(job: Job, folder: Path, monkeypatch: pytest.MonkeyPatch) -> RunRecord:
    """Run a junction as ``egvs run`` does, into FOLDER/run, with a store of its own."""
    with monkeypatch.context() as patch:
        patch.setenv("EGVS_STORE", str(folder / "store"))
        return run.run(egvs.load(job.folder, job.overrides), folder / "run")


def assert_same_run(job: Job, folder: Path) -> None:
    """Assert that a job gave the same artefacts, byte for byte, and the same record except for costs."""
    actual, expected = RunRecord.read(job.out), RunRecord.read(folder / "run")
    for name in STAGE_NAMES:
        if name == "report":  # it shows costs
            continue
        a, b = actual.stages[name], expected.stages[name]
        assert (a.inputs, a.artefacts, a.summary, a.files) == (b.inputs, b.artefacts, b.summary, b.files)
    for name in (name for stage in actual.stages.values() for name in stage.artefacts):
        if name != "report.html":
            assert (job.out / name).read_bytes() == (folder / "run" / name).read_bytes()
