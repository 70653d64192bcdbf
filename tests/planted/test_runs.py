"""What a run writes: exports that are read again, and artefacts that are not those of the scenario."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq
import pytest

import egvs
from egvs.export.export import export_run
from tests.planted import truth
from tests.planted.case import fcd
from tests.planted.heights import RAISED
from tests.planted.outcome import outcome
from tests.planted.reference_systems import MAP
from tests.planted.scenes import Scene, street
from tests.planted.truth import STREET

Call = Callable[..., tuple[int, str, str]]

pytestmark = pytest.mark.system


def scores_of(run_folder: Path) -> dict[str, float]:
    """EGVS of each site of a run."""
    rows = pq.read_table(run_folder / "scores.parquet", columns=["site", "egvs"]).to_pylist()
    return {row["site"]: row["egvs"] for row in rows}


@pytest.fixture(scope="module")
def hill(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The raised street and its run, in the folder ``run`` in it."""
    scene = street(RAISED)
    MAP(scene)
    folder = scene.write(tmp_path_factory.mktemp("hill") / "raised")
    egvs.run(egvs.load(folder), folder / "run")
    return folder


def exported(hill: Path, out: Path) -> Scene:
    """The raised street with footprints and sites that were exported from its run."""
    export_run(hill / "run", "geojson", crs="scenario", out=out)
    export_run(hill / "run", "csv", crs="scenario", out=out)
    scene = street(RAISED)
    MAP(scene)
    scene.files["solids.geojson"] = (out / "footprints.geojson").read_text()
    scene.files["sites.csv"] = (out / "sites.csv").read_text()
    return scene


@pytest.mark.slow
def test_exported_scene_has_the_scores_of_the_oracle(hill: Path, tmp_path: Path) -> None:
    scores, findings = outcome(exported(hill, tmp_path).write(tmp_path / "again"))
    assert [finding for finding in findings if finding.is_error or finding.rule == "heights"] == []
    assert scores == scores_of(hill / "run") == pytest.approx(truth.scores(RAISED), rel=1e-9)


def test_exported_heights_without_their_zero_are_named(hill: Path, tmp_path: Path) -> None:
    scene = exported(hill, tmp_path)
    scene.replace("solids.geojson", '"z_datum"', '"note"')
    _, findings = outcome(scene.write(tmp_path / "again"))
    (error,) = [finding for finding in findings if finding.is_error]
    assert "solids.geojson" in error.where
    assert "112.0 m above the road" in error.problem


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs of the street, and of one whose vehicles drive 2 m farther south, sensors and house included."""
    folder = tmp_path_factory.mktemp("runs")
    other = street()
    del other.config["traffic.roads"]
    fcd(y=lambda row: row["y"] - 2.0)(other)
    other.replace("sites.csv", "3.1", "4.1")
    scenarios = {"right": street().write(folder / "right"), "other": other.write(folder / "other")}
    for name, path in scenarios.items():
        egvs.run(egvs.load(path), folder / f"{name}_run")
    return scenarios | {f"{name}_run": folder / f"{name}_run" for name in scenarios}


@pytest.mark.parametrize(
    ("artefact", "reader"),
    [("trajectories.parquet", "tpog"), ("statics.ply", "tpog"), ("tpog.parquet", "score"), ("scans.parquet", "score")],
)
def test_artefact_of_another_scenario_is_named(
    runs: dict[str, Path], tmp_path: Path, artefact: str, reader: str, run_egvs: Call
) -> None:
    """A stage alone refuses it; a run makes it again, and has the scores of the oracle."""
    out = shutil.copytree(runs["right_run"], tmp_path / "out")
    assert scores_of(out) == pytest.approx(truth.scores(STREET), rel=1e-9)
    shutil.copyfile(runs["other_run"] / artefact, out / artefact)
    code, _, err = run_egvs(reader, runs["right"], "--out", out)
    assert (code, artefact in err) == (2, True), err
    egvs.run(egvs.load(runs["right"]), out)
    assert scores_of(out) == pytest.approx(truth.scores(STREET), rel=1e-9)
