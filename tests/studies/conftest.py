"""A scenario in which SUMO runs."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.studies.short_studies import ROOT


@pytest.fixture
def junction(tmp_path: Path) -> Path:
    """The shipped junction, shortened: SUMO runs in it."""
    folder = tmp_path / "junction"
    shutil.copytree(ROOT / "scenarios" / "nishishinjuku", folder)
    text = (folder / "scenario.toml").read_text()
    for long, short in (
        ("frames = 5000", "frames = 200"),
        ("warmup_s = 300", "warmup_s = 50"),
        ("vehicles = 50", "vehicles = 20"),
        ("voxel_m = 0.25", "voxel_m = 0.5"),
    ):
        assert long in text
        text = text.replace(long, short)
    (folder / "scenario.toml").write_text(text)
    return folder
