"""``egvs scan --points SITE --cloud FORMAT``: the cloud holds the site's returns, where they lie in the world."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.artefacts.run_folder import STAGE_NAMES, RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.core.errors import InputError
from egvs.formats.point_clouds import read_points
from egvs.results.command_entries import DIGEST_KEY, what_if_digest
from egvs.runs.command_results import add_to_report
from egvs.stages import scan

Call = Callable[..., tuple[int, str, str]]
POSITION_M = {"pole_a": (10, 12, 3), "pole_b": (30.5, -12, 3)}


@pytest.fixture
def out(mini: Path, run_egvs: Call, tmp_path: Path) -> Path:
    """A folder with the static world only."""
    folder = tmp_path / "out"
    assert run_egvs("statics", mini, "--out", folder)[0] == 0
    return folder


def clouds(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(out.glob("scan_*"))}


@pytest.mark.parametrize("format_", ["ply", "pcd"])
def test_the_cloud_has_the_points_of_the_scan(mini: Path, run_egvs: Call, out: Path, format_: str) -> None:
    assert run_egvs("scan", mini, "--out", out, "--points", "pole_b", "--cloud", format_)[0] == 0
    assert list(clouds(out)) == [f"scan_pole_b.{format_}"]
    points_m, dropped = read_points(out / f"scan_pole_b.{format_}", "here")
    rows = [row for row in egvs.read_scans(out / "scans.parquet").to_pylist() if row["site"] == "pole_b"]
    returns = np.array([[row["dx_m"], row["dy_m"], row["dz_m"]] for row in rows if row["returned"]])
    assert dropped == 0
    assert 100 < len(returns) < len(rows)
    assert np.array_equal(points_m, returns + POSITION_M["pole_b"])


def test_ply_is_the_default_and_sites_may_be_several(mini: Path, run_egvs: Call, out: Path) -> None:
    assert run_egvs("scan", mini, "--out", out, "--points", "pole_b", "--points", "pole_a")[0] == 0
    assert list(clouds(out)) == ["scan_pole_a.ply", "scan_pole_b.ply"]
    for site, position in POSITION_M.items():
        points, _ = read_points(out / f"scan_{site}.ply", "here")
        assert np.linalg.norm(points - position, axis=1).max() <= 100


@pytest.mark.parametrize("format_", ["ply", "pcd"])
def test_scans_that_are_not_stored_have_the_same_clouds(mini: Path, run_egvs: Call, out: Path, format_: str) -> None:
    arguments = ("scan", mini, "--out", out, "--points", "pole_a", "--cloud", format_)
    assert run_egvs(*arguments)[0] == 0
    kept = clouds(out)
    assert (out / "scans.parquet").exists()
    assert run_egvs(*arguments, "--set", "scan.keep=false")[0] == 0
    assert not (out / "scans.parquet").exists()
    assert clouds(out) == kept


def test_a_cloud_that_was_written_can_be_the_measured_scan(mini: Path, run_egvs: Call, out: Path) -> None:
    """What is read back from the cloud ends where the cast beams ended."""
    assert run_egvs("scan", mini, "--out", out, "--points", "pole_a", "--cloud", "pcd")[0] == 0
    cast = [row for row in egvs.read_scans(out / "scans.parquet").to_pylist() if row["site"] == "pole_a"]
    (mini / "measured.pcd").write_bytes((out / "scan_pole_a.pcd").read_bytes())
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,points\npole_a,10,12,3,measured.pcd\n")
    assert run_egvs("scan", mini, "--out", out)[0] == 0
    ends = [[[row[f"d{axis}_m"] for axis in "xyz"] for row in rows if row["returned"]]
            for rows in (cast, egvs.read_scans(out / "scans.parquet").to_pylist())]  # fmt: skip
    assert np.array(ends[1]) == pytest.approx(np.array(ends[0]), abs=1e-12)


def test_other_formats_and_other_sites_are_refused_by_name(mini: Path, run_egvs: Call, out: Path) -> None:
    code, _, err = run_egvs("scan", mini, "--out", out, "--points", "pole_a", "--cloud", "las")
    assert code == 2
    assert "--cloud" in err and "'las'" in err and "ply or pcd" in err
    code, _, err = run_egvs("scan", mini, "--out", out, "--points", "pole_c")
    assert code == 2
    assert "--points: there is no site 'pole_c'. Choose one of pole_a, pole_b." in err
    assert clouds(out) == {}


def test_rejects_clouds_whose_names_differ_in_case_only() -> None:
    scan._check_cloud_names(["pole_a", "pole_b", "pole_a"])
    with pytest.raises(InputError, match="POLE_a and pole_a give the same file on Windows and macOS"):
        scan._check_cloud_names(["pole_a", "POLE_a"])


@pytest.mark.slow
def test_the_run_stays_complete_and_its_report_shows_later_results(mini: Path, run_egvs: Call, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert run_egvs("run", mini, "--out", run)[0] == 0
    before, report = RunRecord.read(run), (run / "report.html").read_bytes()
    assert run_egvs("scan", mini, "--out", run, "--points", "pole_a")[0] == 0
    after = RunRecord.read(run)
    assert list(after.stages) == list(STAGE_NAMES)
    assert after.stages["report"] == before.stages["report"]
    assert after.stages["scan"].cost == before.stages["scan"].cost

    after.having("report", None).write(run)  # as an older version left it
    names = dict.fromkeys(("best_before", "best_present", "best_expected"), "pole_a")
    answer = {**names, "share": None, "change": None, "conclusion": "pole_a stays", "tables": []}
    answer[DIGEST_KEY] = what_if_digest(egvs.load(mini), [])
    written = add_to_report(run, RunFolder.what_if, {"together": answer})
    assert run / "report.html" in written
    assert b"pole_a stays" in (run / "report.html").read_bytes() and b"pole_a stays" not in report
    assert list(RunRecord.read(run).stages) == list(STAGE_NAMES)
