"""500 frames of SUMO, written in each format of recorded tracks and read back, give the TPOG of SUMO's own file.

Formats with headings and sizes must give the same counts but for voxels that a rounded digit decides. The limit of each
format is the share of occupied voxel frames that may differ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import egvs
from egvs.artefacts.tpog import read_tpog
from egvs.runs import run
from egvs.scenario.track_columns import TrackColumns
from egvs.traffic import sumo
from tests.extensions.tracks import writers, writers_json
from tests.extensions.tracks.writers import TrackRows
from tests.traffic.helpers import netgenerate

pytestmark = [pytest.mark.slow, pytest.mark.system]

CAR = '[[traffic.kinds]]\nname = "car"\nlength_m = 4.55\nwidth_m = 1.8\nheight_m = 1.5\n'
"""The size of a car where a format has none."""

SCENARIO = """\
seed = 1
[roi]
center_m = [100, {middle_m}, 2.5]
size_m = [80, 40, 5]
voxel_m = 0.5
[traffic]
{source}
frame_period_s = 0.1
{kinds}
[tpog]
blocks = 5
[sites]
grid = {{low_m = [90, 10], high_m = [91, 11], spacing_m = 1, heights_m = [3]}}
{crs}
"""

ROUTES = """\
<routes>
    <vType id="car" length="4.55" width="1.8" height="1.5" sigma="0.5"/>
    {trips}
</routes>
"""


def simulate(folder: Path, network: Path, pairs: list[tuple[str, str]]) -> Path:
    """Run SUMO; return its FCD of 500 frames, 0.1 s apart, with vehicles on all routes."""
    trips = "".join(
        f'<trip id="{10 * number + route}" type="car" depart="{2.5 * number}" departSpeed="max"'
        f' from="{start}" to="{end}"/>'
        for number in range(32)
        for route, (start, end) in enumerate(pairs)
    )
    (folder / "trips.rou.xml").write_text(ROUTES.format(trips=trips))
    flags = ["-n", network.name, "-r", "trips.rou.xml", "--seed", "1", "--step-length", "0.1", "--end", "80"]
    flags += ["--fcd-output", "fcd.csv", "--device.fcd.begin", "30", "--no-step-log", "--precision", "6"]
    flags += ["--fcd-output.attributes", "id,x,y,angle,type,speed"]
    sumo.run_program("sumo", flags, folder)
    return folder / "fcd.csv"


def trajectories_of(folder: Path, source: str, middle_m: float, crs: str = "", kinds: str = CAR) -> Path:
    """Run the scenario up to the TPOG, and return the run folder."""
    text = SCENARIO.format(source=source, middle_m=middle_m, crs=crs, kinds=kinds)
    (folder / "scenario.toml").write_text(text)
    run.run(egvs.load(folder), folder / "run", only=("traffic", "statics", "tpog"))
    return folder / "run"


class Recorded:
    """SUMO's own result: the run, and its boxes as rows."""

    def __init__(self, folder: Path, middle_m: float) -> None:
        self.middle_m = middle_m
        self.run = trajectories_of(folder, 'fcd = "fcd.csv"', middle_m)
        table = pq.read_table(self.run / "trajectories.parquet")
        numbers = {
            key: table[key].to_numpy() for key in ("x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
        }
        names = table["vehicle"].to_pylist()
        self.rows = TrackRows(table["frame"].to_numpy() * 0.1, names, ["car"] * len(names), **numbers)
        assert table["frame"].to_numpy().max() >= 499


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Return traffic that turns at a crossing at (100, 100)."""
    folder = tmp_path_factory.mktemp("crossing")
    flags = ["--grid", "--grid.number", "1", "--grid.length", "100", "--grid.attach-length", "100"]
    network = netgenerate(folder, *flags, "--offset.disable-normalization", "false")
    simulate(folder, network, [("left0A0", "A0top0"), ("bottom0A0", "A0left0"), ("right0A0", "A0bottom0")])
    return Recorded(folder, 100.0)


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Return traffic in both directions of a straight road along x."""
    folder = tmp_path_factory.mktemp("straight")
    (folder / "nodes.nod.xml").write_text('<nodes><node id="a" x="0" y="0"/><node id="b" x="200" y="0"/></nodes>')
    edges = '<edges><edge id="ab" from="a" to="b"/><edge id="ba" from="b" to="a"/></edges>'
    (folder / "edges.edg.xml").write_text(edges)
    sumo.run_program("netconvert", ["-n", "nodes.nod.xml", "-e", "edges.edg.xml", "-o", "net.xml"], folder)
    simulate(folder, folder / "net.xml", [("ab", "ab"), ("ba", "ba")])
    return Recorded(folder, 0.0)


COLUMNS = TrackColumns(
    time="t", id="id", x="x", y="y", yaw="yaw", length="l", width="w", height="h", type="c", delimiter=";"
)

WORLD = 'track_crs = "world"'


def crs(epsg: int, origin_m: tuple[float, float]) -> str:
    return f"[crs]\nepsg = {epsg}\noffset_m = [{-origin_m[0]!r}, {-origin_m[1]!r}]\n"


FORMATS: dict[str, tuple[Callable[[Path, TrackRows], Path], str, str, float]] = {
    "INTERACTION": (writers.write_interaction, WORLD, "", 1e-3),
    "TAF-BW": (writers.write_taf_bw, WORLD, "", 1e-3),
    "SinD": (writers.write_sind, WORLD, "", 1e-3),
    "inD": (writers.write_levelx, "", crs(32632, writers.LEVELX_ORIGIN_M), 1e-3),
    "LUMPI": (writers.write_lumpi, WORLD, "", 1e-3),
    "OpenLABEL": (writers_json.write_openlabel, WORLD, "", 1e-3),
    "TUMTraf": (writers_json.write_tumtraf, WORLD, "", 1e-3),
    "V2X-Seq labels": (writers_json.write_dair_v2x, WORLD, "", 1e-3),
    "V2X-Seq trajectories": (writers_json.write_v2x_seq_tfd, WORLD, "", 1e-3),
    "Argoverse 2 scenario": (writers_json.write_argoverse2_scenario, WORLD, "", 1e-3),
    "Argoverse 2 annotations": (writers_json.write_argoverse2, WORLD, "", 1e-3),
    "OSI": (writers_json.write_osi, WORLD, "", 1e-3),
    "OSI in MCAP": (writers_json.write_osi_mcap, WORLD, "", 1e-3),
    # headings come from the motion; positions are rounded to 0.11 m x 0.09 m, a fifth of a voxel
    "pNEUMA": (writers.write_pneuma, "", crs(32634, writers.PNEUMA_ORIGIN_M), 0.2),
    "pNEUMA, more digits": (partial(writers.write_pneuma, decimals=9), "", crs(32634, writers.PNEUMA_ORIGIN_M), 0.02),
}
"""Writer, keys of ``[traffic]``, table ``[crs]``, and the limit, of each format."""


def difference(recorded: Recorded, path: Path, keys: str, crs_table: str) -> float:
    """Return the share of occupied voxel frames that differs between SUMO's own file and the tracks."""
    source = f'tracks = ["{path.name}"]\n{keys}'
    actual = read_tpog(trajectories_of(path.parent, source, recorded.middle_m, crs_table, CAR) / "tpog.parquet").counts
    expected = read_tpog(recorded.run / "tpog.parquet").counts
    assert expected.sum() > 10_000
    return float(np.abs(actual - expected).sum() / expected.sum())


@pytest.mark.parametrize("name", FORMATS)
def test_turning_traffic_gives_the_same_tpog(name: str, crossing: Recorded, tmp_path: Path) -> None:
    write, keys, crs_table, limit = FORMATS[name]
    path = write(tmp_path, crossing.rows)
    (tmp_path / "scenario.toml").unlink(missing_ok=True)
    assert difference(crossing, path, keys, crs_table) <= limit


@pytest.mark.parametrize(("write", "limit"), [(writers.write_highd, 1e-3), (writers.write_ngsim, 1e-3)])
def test_traffic_on_a_road_gives_the_same_tpog(
    write: Callable[[Path, TrackRows], Path], limit: float, straight: Recorded, tmp_path: Path
) -> None:
    assert difference(straight, write(tmp_path, straight.rows), WORLD, "") <= limit


@pytest.mark.parametrize("json_lines", [False, True], ids=["CSV", "JSON lines"])
def test_own_table_gives_the_same_tpog(json_lines: bool, crossing: Recorded, tmp_path: Path) -> None:
    mapping = COLUMNS if not json_lines else COLUMNS.model_copy(update={"delimiter": ","})
    path = writers.write_user_table(tmp_path, crossing.rows, mapping, json_lines)
    table = "".join(f"{key} = {value!r}\n" for key, value in mapping.model_dump(exclude_unset=True).items())
    source = f'tracks = ["{path.name}"]'
    kinds = f"[traffic.track_columns]\n{table}\n{CAR}"
    folder = trajectories_of(tmp_path, source, crossing.middle_m, "", kinds)
    actual, expected = (read_tpog(run_folder / "tpog.parquet").counts for run_folder in (folder, crossing.run))
    assert np.abs(actual - expected).sum() <= 1e-3 * expected.sum()


def test_detects_moved_track(crossing: Recorded, tmp_path: Path) -> None:
    """The comparison can fail: 0.2 m to the side change a tenth of the counts."""
    path = writers.write_interaction(tmp_path, replace(crossing.rows, x_m=crossing.rows.x_m + 0.2))
    assert difference(crossing, path, WORLD, "") > 0.05
