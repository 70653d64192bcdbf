"""Recorded against simulated traffic: by hand, against scipy, and from two runs to a page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import jensenshannon

import egvs
from egvs.core.errors import InputError
from egvs.core.grid import Grid
from egvs.extensions.tracks.comparison import tpog_page
from egvs.extensions.tracks.comparison.lane_bins import BIN_M, lane_bins, lane_distances
from egvs.extensions.tracks.comparison.tpog_comparison import Measured, compare_tpogs, measure
from egvs.scoring.standard_errors import BlockGroups
from egvs.traffic.network import read_net_xml
from tests.conftest import write_mini
from tests.installed import needs

NETWORK = """<net version="1.20">
    <location netOffset="0.00,0.00" convBoundary="-20,-2,60,2" origBoundary="0,0,0,0" projParameter="!"/>
    <edge id="east" from="w" to="e"><lane id="east_0" index="0" speed="10" length="80" shape="-20,-2 60,-2"/></edge>
    <edge id="west" from="e" to="w"><lane id="west_0" index="0" speed="10" length="80" shape="60,2 -20,2"/></edge>
    <junction id="w" type="dead_end" x="-20" y="0" incLanes="west_0" intLanes="" shape="-20,-4 -20,4"/>
    <junction id="e" type="dead_end" x="60" y="0" incLanes="east_0" intLanes="" shape="60,-4 60,4"/>
</net>
"""


def make_run(folder: Path, *, stands_at_m: float | None = None) -> Path:
    """Run the small scenario with a network; its eastbound car may stand still."""
    scenario = write_mini(folder)
    (scenario / "roads.net.xml").write_text(NETWORK)
    text = (scenario / "scenario.toml").read_text()
    (scenario / "scenario.toml").write_text(text.replace('fcd = "fcd.csv"', 'fcd = "fcd.csv"\nroads = "roads.net.xml"'))
    if stands_at_m is not None:
        lines = []
        for line in (scenario / "fcd.csv").read_text().splitlines():
            cells = line.split(";")
            if cells[1] == "east":
                cells[2] = f"{stands_at_m:.1f}"
            lines.append(";".join(cells))
        (scenario / "fcd.csv").write_text("\n".join([*lines, ""]))
    out = folder.with_name(f"run-{folder.name}")
    egvs.run(egvs.load(scenario), out)
    return out


def test_distance_by_hand() -> None:
    """The same distribution at another volume has the distance 0, disjoint ones have 1; NaN without traffic."""
    first = np.array([[0.2], [0.4], [0.3], [0.0], [0.0], [0.0]])
    second = np.array([[0.1], [0.2], [0.0], [0.7], [0.1], [0.1]])
    distances = lane_distances(first, second, np.array([0, 0, 1, 1, 2, 2]))
    assert distances[:2, 0].tolist() == pytest.approx([0.0, 1.0])
    assert np.isnan(distances[2, 0])


def test_distance_is_that_of_scipy() -> None:
    rng = np.random.default_rng(3)
    first, second = rng.uniform(size=(2, 12, 5))
    first[rng.uniform(size=first.shape) < 0.3] = 0.0
    lane_of_bin = np.array([0, 1, 2] * 4)
    distances = lane_distances(first, second, lane_of_bin)
    for lane in range(3):
        for column in range(5):
            bins = [values[lane_of_bin == lane, column] for values in (first, second)]
            assert distances[lane, column] == pytest.approx(jensenshannon(*bins, base=2.0))


def test_standard_error_of_a_mean_is_that_of_its_blocks() -> None:
    """Blocks of 0.5, 0.7, 0.5 and 0.9: mean 0.65, standard error sqrt(0.11 / 3 / 4)."""
    blocks = np.array([0.5, 0.7, 0.5, 0.9])
    left_out = np.array([[blocks.mean(), *((blocks.sum() - block) / 3 for block in blocks)]])
    (measured,) = measure(left_out, (BlockGroups(np.full(4, 10), 0.0),))
    assert measured.value == pytest.approx(0.65)
    assert measured.se == pytest.approx((0.11 / 3 / 4) ** 0.5)
    assert measured.bias == pytest.approx(0.0)


def test_value_that_is_unknown_in_a_replicate_has_no_error() -> None:
    (measured,) = measure(np.array([[0.4, 0.5, np.nan]]), (BlockGroups(np.full(2, 10), 0.0),))
    assert measured == Measured(0.4)


def test_columns_of_lanes(tmp_path: Path) -> None:
    """Lanes are 3.2 m wide: y from -3.6 to -0.4, and from 0.4 to 3.6; columns are 0.5 m wide."""
    (tmp_path / "roads.net.xml").write_text(NETWORK)
    grid = Grid((0.0, -10.0, 0.0), 0.5, (80, 40, 10))
    covered = np.ones((80, 40))
    covered[60:] = 0.0
    bins = lane_bins(read_net_xml(tmp_path / "roads.net.xml"), grid, covered.ravel())
    assert set(bins.names) == {"east_0", "west_0"}
    lane = bins.lane.reshape(80, 40)
    number = bins.names.index("east_0")
    y_m = -10.0 + 0.5 * (np.arange(40) + 0.5)
    assert ((lane[10] == number) == ((y_m > -3.6) & (y_m < -0.4))).all()
    assert (lane[60:] == -1).all()
    # along the lane, x = 0 is 20 m from its start; bins of 2.5 m are five columns
    of_lane = bins.bin.reshape(80, 40)[:60, int(np.flatnonzero(y_m == -2.25)[0])]
    assert BIN_M == 2.5
    assert np.diff(of_lane).nonzero()[0].tolist() == [4, 9, 14, 19, 24, 29, 34, 39, 44, 49, 54]
    assert (bins.lane_of_bin[of_lane] == number).all()


@pytest.mark.slow
def test_equal_runs_do_not_differ(tmp_path: Path) -> None:
    first, second = make_run(tmp_path / "a"), make_run(tmp_path / "b")
    comparison = compare_tpogs(first, second)
    assert comparison.distance.value == 0.0
    assert comparison.entropy_bit[2].value == 0.0
    assert comparison.entropy_bit[0].value == comparison.entropy_bit[1].value > 0
    assert comparison.covered_share == 1.0
    assert comparison.ranks is not None
    assert comparison.ranks.sites == 2
    assert (comparison.ranks.tau.value, comparison.ranks.lost.value) == (1.0, 0.0)
    assert [lane.distance for lane in comparison.lanes if lane.distance is None] == []


@pytest.mark.slow
def test_car_that_stands_is_told_from_one_that_drives(run_egvs, tmp_path: Path) -> None:
    """It fills 4.5 m of its lane all the time: the distance is that of this distribution from the moving car's."""
    drives, stands = make_run(tmp_path / "a"), make_run(tmp_path / "b", stands_at_m=22.25)
    comparison = compare_tpogs(drives, stands)
    lanes = {lane.name: lane for lane in comparison.lanes}
    west, east = lanes["west_0"], lanes["east_0"]
    assert west.distance is not None
    assert west.distance.value == 0.0
    assert east.distance is not None
    assert 0.5 < east.distance.value < 1.0
    assert east.distance.se is not None
    # 4.5 m of 40 m, in 1.8 m of 3.2 m (voxels of 0.5 m: 5 of 7 rows at most)
    assert 0.05 < east.occupancy[1].value < 0.12
    assert east.entropy_bit[1].value < east.entropy_bit[0].value

    page = tmp_path / "page.html"
    code, out, err = run_egvs("compare", drives, stands, "--tpog", page)
    assert (code, err) == (0, "")
    assert "Jensen-Shannon distance over all lanes: " + tpog_page.format_measured(comparison.distance) in out
    assert "ranks of 2 sites: Kendall's tau" in out
    html = page.read_text(encoding="utf-8")
    assert tpog_page.format_measured(east.distance) in html
    assert html.count("<svg") == 2
    assert "Recorded" in html
    assert "Simulated" in html


@pytest.mark.slow
@needs("tracks")
def test_only_what_the_recording_covered_counts(run_egvs, tmp_path: Path) -> None:
    """The recorded cars drive in the western half of the region, and the recording saw no more."""
    simulated = make_run(tmp_path / "simulated")
    scenario = write_mini(tmp_path / "recorded")
    (scenario / "roads.net.xml").write_text(NETWORK)
    rows = ["track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy,psi_rad,length,width"]
    for k in range(41):
        rows.append(f"1,{k},{500 * k},car,{0.5 * k},-2,1,0,0,4.5,1.8")
        rows.append(f"2,{k},{500 * k},car,{20 - 0.5 * k},2,-1,0,{np.pi},4.5,1.8")
    (scenario / "tracks.csv").write_text("\n".join([*rows, ""]))
    text = (scenario / "scenario.toml").read_text()
    source = 'tracks = ["tracks.csv"]\ntrack_crs = "world"\nroads = "roads.net.xml"'
    (scenario / "scenario.toml").write_text(text.replace('fcd = "fcd.csv"', source))
    recorded = tmp_path / "run-recorded"
    egvs.run(egvs.load(scenario), recorded)

    comparison = compare_tpogs(recorded, simulated)
    # the hull of the centres ends at x = 20, and is widened by 2 m: 22 of 40 m
    assert comparison.covered_share == pytest.approx(0.55, abs=0.03)
    # both traffics are uniform in the common part
    assert comparison.distance.value < 0.35
    code, out, err = run_egvs("compare", recorded, simulated, "--tpog", tmp_path / "page.html")
    assert (code, err) == (0, "")
    assert "note: the recording covered 5" in out
    assert "where the recording did not cover it, ranks differ" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_rejects_other_numbers_of_runs(run_egvs, tmp_path: Path) -> None:
    code, _, err = run_egvs("compare", tmp_path, "--tpog", tmp_path / "page.html")
    assert code == 2
    assert "--tpog: expected two runs, the recorded and the simulated one, got 1" in err


def test_rejects_page_of_another_type(run_egvs, tmp_path: Path) -> None:
    code, _, err = run_egvs("compare", tmp_path, tmp_path, "--tpog", tmp_path / "page.pdf")
    assert code == 2
    assert "--tpog: expected a file PAGE.html to write" in err


@pytest.mark.slow
def test_rejects_runs_without_lanes_and_of_other_regions(mini: Path, tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    egvs.run(egvs.load(mini), plain)
    with pytest.raises(InputError, match="neither run has a network"):
        compare_tpogs(plain, plain)
    other = tmp_path / "other"
    egvs.run(egvs.load(mini, ["roi.voxel_m=1"]), other)
    with pytest.raises(InputError, match="its region or voxels differ"):
        compare_tpogs(plain, other)


def test_numbers_of_the_page() -> None:
    assert tpog_page.format_measured(None) == "–"
    assert tpog_page.format_measured(Measured(0.426, 0.033, 0.05)) == "0.43 ± 0.03"
    assert tpog_page.format_share(Measured(0.0236, 0.0135)) == "2.4 ± 1.4 %"
    assert tpog_page.format_bit(Measured(36362.0, 12943.2)) == "36,362 ± 12,943"
