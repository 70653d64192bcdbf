"""The section on sheets, acceptance and sensor design: what the page says of records written by hand."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from egvs.artefacts.command_results import CommandResult, read_results, write_results
from egvs.artefacts.readers import read_scores
from egvs.core.errors import InputError
from egvs.extensions.hardware.files import ACCEPTANCE, FILES, SHEETS, design_digest
from egvs.results.command_entries import DIGEST_KEY
from egvs.scenario.model import Scenario
from tests.report.small_runs import render_report, run_to_scores, section_text

STAGES = {"traffic": "", "tpog": ""}
"""Inputs of stages as in :func:`tests.report.small_runs.make_record`."""


@pytest.fixture
def run(tmp_path: Path) -> tuple[Scenario, Path]:
    return run_to_scores(tmp_path)


def write(path: Path, name: str, values: Mapping[str, Any], stages: Mapping[str, str] = STAGES) -> None:
    write_results(path, {name: CommandResult(stages, values)})


def pose_of(out: Path) -> tuple[str, dict[str, float]]:
    best = read_scores(out / "scores.parquet").to_pylist()[0]
    return best["site"], {name: best[name] for name in ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")}


def sheet_values(pose: Mapping[str, float]) -> dict[str, Any]:
    return {
        "sensor": "small", "pose": pose, "height_m": 3.456, "bearing_deg": 359.96,
        "tolerances": {"tilt": "2.1 degrees", "height": "0.30 m"},
        "file": "installation_x.pdf", "path": "sheets/installation_x.pdf",
    }  # fmt: skip


def accept_values(pose: Mapping[str, float], *reasons: str) -> dict[str, Any]:
    return {"sensor": "small", "pose": pose, "passed": not reasons, "reasons": list(reasons), "path": ""}


def design_values(scenario: Scenario) -> dict[str, Any]:
    def row(sensor: str, search: float, score: float, gain: float, chosen: bool) -> dict[str, Any]:
        difference = {"value": gain, "se": 0.01, "better": 0.5 if gain < 0.02 else 0.99}
        pose = {"height_m": 4.0, "yaw_deg": 90.0, "pitch_deg": -10.0}
        scores = {"search_score": search, "score": score, "se": 0.02, "difference": difference}
        return {"sensor": sensor, **pose, **scores, "chosen": chosen}

    rows = [row("small", 0.81, 0.802, 0.0, False), row("designed", 0.85, 0.843, 0.041, True)]
    return {
        "frames": [1200, 1300],
        "designs": rows,
        "notes": ["One was left out."],
        DIGEST_KEY: design_digest(scenario),
    }


def test_shows_sheet_with_its_link(run: tuple[Scenario, Path]) -> None:
    """3.456 m is 3.46 m; a bearing of 359.96 degrees is north; the pitch of the site is 0."""
    scenario, out = run
    site, pose = pose_of(out)
    write(out / "sheets.json", site, sheet_values(pose))
    page = render_report(scenario, out)
    text = section_text(page, "installation")
    assert text is not None
    assert f"{site} small 3.46 0.0° level tilt 2.1 degrees, height 0.30 m installation_x.pdf" in text
    assert 'href="sheets/installation_x.pdf"' in page


def test_sheet_and_acceptance_at_another_pose_are_not_shown(run: tuple[Scenario, Path]) -> None:
    scenario, out = run
    site, pose = pose_of(out)
    moved = {**pose, "z_m": pose["z_m"] + 0.01}
    write(out / "sheets.json", site, sheet_values(moved))
    write(out / "acceptance.json", site, accept_values(moved))
    write(out / "acceptance.json", "no_such_site", accept_values(pose))
    page = render_report(scenario, out)
    assert section_text(page, "installation") is None
    assert section_text(page, "acceptance") is None


def test_shows_both_verdicts(run: tuple[Scenario, Path]) -> None:
    scenario, out = run
    site, pose = pose_of(out)
    write(out / "acceptance.json", site, accept_values(pose, "tilt is off by 1.5 degrees, limit 1", "x < y"))
    text = section_text(render_report(scenario, out), "acceptance")
    assert text is not None
    assert f"{site} small failed tilt is off by 1.5 degrees, limit 1; x < y" in text
    write(out / "acceptance.json", site, accept_values(pose))  # after it was corrected
    text = section_text(render_report(scenario, out), "acceptance")
    assert text is not None
    assert f"{site} small passed –" in text
    assert "failed" not in text


def test_shows_sensor_design(run: tuple[Scenario, Path]) -> None:
    scenario, out = run
    write(out / "sensor_design.json", "south", design_values(scenario))
    page = render_report(scenario, out)
    text = section_text(page, "sensor-design")
    assert text is not None
    assert "searched with 1,200 frames and scored with 1,300 others" in text
    assert "small 4.00 90.0 -10.0 81.0 % 80.2 ± 2.0 % +0.0 ± 1.0" in text
    assert "designed 4.00 90.0 -10.0 85.0 % 84.3 ± 2.0 % +4.1 ± 1.0" in text
    assert '<tr class="top"><th scope="row">designed' in page
    assert "One was left out." in text
    other = scenario.score.model_copy(update={"sampled_frames": scenario.score.sampled_frames + 1})
    assert section_text(render_report(scenario.model_copy(update={"score": other}), out), "sensor-design") is None


@pytest.mark.slow
@pytest.mark.parametrize("file", [file.name for file in FILES])
def test_results_of_other_traffic_are_not_shown(run: tuple[Scenario, Path], file: str) -> None:
    """The page is the same, byte for byte, as without the file."""
    scenario, out = run
    before = render_report(scenario, out)
    site, pose = pose_of(out)
    values = {
        "sheets.json": sheet_values(pose),
        "acceptance.json": accept_values(pose),
        "sensor_design.json": design_values(scenario),
    }
    write(out / file, site, values[file], {"traffic": "other inputs"})
    assert render_report(scenario, out) == before
    write(out / file, site, values[file], {"traffic": "", "score": ""})  # score was not recorded
    assert render_report(scenario, out) == before
    write(out / file, site, values[file])
    assert render_report(scenario, out) != before


def test_entries_of_other_names_stay(tmp_path: Path) -> None:
    path = tmp_path / SHEETS.name
    assert read_results(path) == {}
    write(path, "a", {"n": 1})
    write(path, "b", {"n": 2})
    write(path, "a", {"n": 3})
    assert {name: entry.values["n"] for name, entry in read_results(path).items()} == {"a": 3, "b": 2}


def test_changed_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / ACCEPTANCE.name
    write(path, "a", {"passed": False})
    value = json.loads(path.read_text())
    value["entries"]["a"]["values"]["passed"] = True
    path.write_text(json.dumps(value))
    with pytest.raises(InputError, match=r"acceptance\.json: was changed: .* Remove it and repeat"):
        read_results(path)
    with pytest.raises(InputError, match="was changed"):
        write(path, "b", {"passed": True})
