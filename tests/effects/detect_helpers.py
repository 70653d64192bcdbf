"""Scores and hits of a small scenario with effects on detection."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import strategies as st

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.tpog import read_tpog
from egvs.effects import registry
from egvs.effects.base import Effect
from egvs.runs.run_context import open_folder
from egvs.scoring.scorer import Scorer
from egvs.sensors import sensor, sites
from egvs.sensors.scene import Scene
from egvs.stages import scan, score, statics, tpog, traffic
from egvs.stages.site_scoring import empty_scans
from tests.conftest import BUILDING, collection, fcd, feature
from tests.stage_runner import run_stage

# Settings that activate each effect.
ACTIVE = {
    "range_limit": ["effects.range_limit.rated_range_m=30"],
    "rain": ["effects.rain.rate_mm_h=50"],
    "fog": ["effects.fog.visibility_m=100"],
    "dropout": ["effects.dropout.share=0.2"],
}


def write_scenario(folder: Path, scenario: str, sites_csv: str) -> Path:
    folder.mkdir()
    (folder / "scenario.toml").write_text(scenario)
    (folder / "fcd.csv").write_text(fcd())
    (folder / "sites.csv").write_text(sites_csv)
    house = feature({"type": "Polygon", "coordinates": BUILDING}, name="house", kind="building", height_m=6)
    (folder / "statics.geojson").write_text(collection(house))
    return folder


def run_stages(folder: Path, out: Path) -> tuple[Path, Path]:
    """Run all but the report in ``out``."""
    out.mkdir()
    scenario = egvs.load(folder)
    for stage in (statics, scan, traffic, tpog, score):
        run_stage(stage, scenario, out)
    return folder, out


def scored(score_run: tuple[Path, Path], settings: list[str], jobs: int | None = None) -> tuple[dict[str, list], bytes]:
    """Columns of scores.parquet under these settings, and its bytes; the module's artefacts stay as they are."""
    folder, out = score_run
    run_stage(score, egvs.load(folder, settings), out, jobs=jobs)
    table, _ = parquet.read_artefact(out / "scores.parquet", "scores")
    return table.to_pydict(), (out / "scores.parquet").read_bytes()


def score_hits(score_run: tuple[Path, Path], settings: list[str]) -> np.ndarray:
    """Hits of the first site in each voxel, (nx, ny, nz)."""
    folder, out = score_run
    scenario = egvs.load(folder, settings)
    work = open_folder(scenario, out)
    first = next(iter(empty_scans(work)))
    return Scorer(work.scene, read_tpog(out / "tpog.parquet")).hits(first.beams)


def hits_along_beam(one_beam_run: tuple[Path, Path], *settings: str) -> np.ndarray:
    """Hits of the only beam in the voxels along it, (nx,)."""
    result = score_hits(one_beam_run, list(settings))
    assert result[:, 20, 4].sum() == result.sum()
    return result[:, 20, 4]


def make_effect(name: str, **parameters: object) -> Effect:
    return registry.make_effect(name, registry.load_effect_class(name).Model.from_dict(parameters))


def make_scene(score_run: tuple[Path, Path], *settings: str) -> Scene:
    scenario = egvs.load(score_run[0], settings)
    return Scene(scenario, None, sites.candidate_sites(scenario))  # type: ignore[arg-type]


visibility_m = st.floats(1, 1e5)


SENSOR = sensor.Sensor("test", (0.0,), (0.0,), 1, 100.0, "this test", rated_range_m=40.0)


RANGES_M = np.linspace(0.01, 200.0, 400)
