"""A plan is a layer of its own, as long as it is a plan of the run that is exported."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import egvs

Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def planned(local: Path, tmp_path: Path) -> Path:
    """A copy of a run, with a plan in its folder."""
    shutil.copytree(local.parent, tmp_path / "copy")
    folder = tmp_path / "copy" / "run"
    egvs.place(egvs.load(tmp_path / "copy" / "mini", ["placement.count=1"]), folder)
    return folder


def test_a_plan_is_a_layer_until_the_run_is_another_one(planned: Path, tmp_path: Path, run_egvs: Call) -> None:
    code, told, _ = run_egvs("export", planned, "--to", "csv", "--out", tmp_path / "a")
    assert (code, "plan" in told.splitlines()[0]) == (0, False)
    with (tmp_path / "a" / "plan.csv").open(encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file))
    places = {"pole_a": ("10.0", "12.0"), "pole_b": ("30.5", "-12.0")}
    assert [(row["order"], row["easting_m"], row["northing_m"]) for row in rows] == [("1", *places[rows[0]["site"]])]
    egvs.run(egvs.load(planned.parent / "mini", ["roi.voxel_m=1"]), planned)
    code, told, _ = run_egvs("export", planned, "--to", "csv", "--out", tmp_path / "b")
    assert code == 0
    assert told.startswith("the plan is left out: it was made of other traffic, sites or settings; egvs place makes")
    assert not (tmp_path / "b" / "plan.csv").exists()


def test_a_damaged_plan_is_refused(planned: Path, tmp_path: Path, run_egvs: Call) -> None:
    path = planned / "placement.parquet"
    path.write_bytes(path.read_bytes()[:-9])
    code, _, err = run_egvs("export", planned, "--to", "csv", "--out", tmp_path / "a")
    assert code == 2
    assert "placement.parquet: does not match its checksum in placement.sha256. Remove it, or run egvs" in err
