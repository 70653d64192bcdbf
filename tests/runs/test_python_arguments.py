"""A wrong argument of a function of the Python API is one message that names it."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest

import egvs
from egvs.core.errors import InputError
from tests.conftest import collection, feature


def test_one_text_is_no_list(mini: Path) -> None:
    with pytest.raises(InputError, match=r"^overrides: expected a list of texts, got 'traffic\.frames=3'"):
        egvs.load(mini, "traffic.frames=3")
    with pytest.raises(InputError, match=r"^names: expected a list of texts, got 'lorry'"):
        egvs.what_if(mini, names="lorry")


def test_what_if_takes_folders(mini: Path) -> None:
    with pytest.raises(InputError, match=r"^path: expected the folder of a scenario or run, got a Scenario"):
        egvs.what_if(egvs.load(mini))  # type: ignore[arg-type]


def test_readers_take_files(mini: Path, tmp_path: Path) -> None:
    egvs.run(egvs.load(mini), tmp_path / "run")
    with pytest.raises(InputError, match=r"expected the file scores\.parquet, got a folder\. Use .*run/scores"):
        egvs.read_scores(tmp_path / "run")
    with pytest.raises(InputError, match=r'no such file\. Run with score\.keep_visibility = \["pole_a"\], or "all"'):
        egvs.read_visibility(tmp_path / "run" / "visibility.parquet", "pole_a")
    with pytest.raises(InputError, match=r"there is no period 'night'\. Its traffic has no periods: name none"):
        egvs.read_tpog(tmp_path / "run" / "tpog.parquet", "night")
    metadata = json.loads(pq.read_metadata(tmp_path / "run" / "scores.parquet").metadata[b"egvs"])
    assert metadata["scenario"]["name"] == "mini"  # as docs/artefacts.md says


@pytest.mark.slow
def test_what_if_result_is_one_line(mini: Path, tmp_path: Path) -> None:
    (mini / "scenario.toml").write_text(
        (mini / "scenario.toml").read_text() + '\n[what_if.works]\nshare = 0.5\nfootprints = ["works.geojson"]\n'
    )
    ring = [[30, 5], [34, 5], [34, 7], [30, 7], [30, 5]]
    works = feature({"type": "Polygon", "coordinates": [ring]}, name="works", kind="building", height_m=3)
    (mini / "works.geojson").write_text(collection(works))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        result = egvs.what_if(mini)
    assert repr(result).startswith("WhatIfResult(best pole_") and "works pole_" in repr(result)
    assert len(repr(result)) < 200
