"""A town with traffic, made once for all tests of the traffic."""

import shutil
from pathlib import Path

import pytest

from egvs.artefacts import parquet
from egvs.stages import traffic
from egvs.traffic import sumo
from tests.stage_runner import run_stage
from tests.traffic.helpers import FOREIGN_TEXT, SMALL, first_lane, netgenerate, scenario


@pytest.fixture(scope="session")
def town(tmp_path_factory):
    """A folder with a signalised 2 x 2 grid of streets that lead out of town."""
    folder = tmp_path_factory.mktemp("town")
    netgenerate(
        folder, "--grid", "--grid.number", "2", "--grid.length", "90", "--grid.attach-length", "120", "-L", "2",
        "--default-junction-type", "traffic_light", "--no-turnarounds", "--offset.disable-normalization",
    )  # fmt: skip
    return folder


@pytest.fixture(scope="session")
def recorded(town, tmp_path_factory):
    """The stage's result, table and folder for the town's drawn traffic."""
    out = tmp_path_factory.mktemp("recorded")
    result = run_stage(traffic, scenario(town, network="net.xml", **SMALL), out)
    table, metadata = parquet.read_artefact(out / "trajectories.parquet", "trajectories")
    return result, table, metadata, out


@pytest.fixture
def retry_connecting(monkeypatch):
    """SUMO listens a moment after it was started."""
    connect = sumo._connect

    def again(host, port):
        return next(filter(None, (connect(host, port) for _ in range(1_000_000))))

    monkeypatch.setattr(sumo, "_connect", again)


@pytest.fixture
def demand_folder(town, tmp_path) -> Path:
    """A folder with the town and the route of a car; next to it, a file that SUMO must not change."""
    folder = tmp_path / "in"
    folder.mkdir()
    shutil.copy(town / "net.xml", folder)
    edge = first_lane(town / "net.xml")[0]
    route = f'<vehicle id="v" depart="0"><route edges="{edge}"/></vehicle>'
    (folder / "own.rou.xml").write_text(f"<routes>{route}</routes>")
    (tmp_path / "foreign.txt").write_text(FOREIGN_TEXT)
    return folder
