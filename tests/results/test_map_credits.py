"""The foot of the report names who made the maps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from egvs.results.map_credits import read_map_credits
from egvs.scenario import loading

CREDIT = "(c) OpenStreetMap contributors, ODbL"


def name_makers(folder: Path, attribution: str) -> None:
    statics = json.loads((folder / "statics.geojson").read_text())
    (folder / "statics.geojson").write_text(json.dumps({"attribution": attribution} | statics))


@pytest.mark.slow
@pytest.mark.system
def test_report_names_the_makers_of_the_map(mini: Path, tmp_path: Path, run_egvs: Any) -> None:
    assert run_egvs("run", mini, "--out", tmp_path / "plain")[0] == 0
    assert "Map data" not in (tmp_path / "plain" / "report.html").read_text()
    name_makers(mini, CREDIT)
    assert run_egvs("run", mini, "--out", tmp_path / "plain")[0] == 0
    footer = (tmp_path / "plain" / "report.html").read_text().partition("<footer>")[2]
    assert f"Map data {CREDIT}." in footer


@pytest.mark.parametrize(
    ("attribution", "expected"),
    [
        (CREDIT, (CREDIT,)),
        (f'{CREDIT}; City of \\ "X" <b>', (CREDIT, 'City of \\ "X" <b>')),
        ("", ()),
    ],
)
def test_attribution_in_the_head_is_read(mini: Path, attribution: str, expected: tuple[str, ...]) -> None:
    name_makers(mini, attribution)
    assert read_map_credits(loading.load(mini)) == expected


def test_attribution_of_an_object_is_not_that_of_the_map(mini: Path) -> None:
    statics = json.loads((mini / "statics.geojson").read_text())
    statics["features"][0]["properties"]["attribution"] = "nobody"
    (mini / "statics.geojson").write_text(json.dumps(statics))
    assert read_map_credits(loading.load(mini)) == ()
