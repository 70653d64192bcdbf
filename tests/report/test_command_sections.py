"""Sections on what-ifs, sheets, acceptance and sensor design: what the page says of records written by hand."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from egvs.artefacts.command_results import CommandResult, read_results, write_results
from egvs.artefacts.readers import read_scores
from egvs.artefacts.run_folder import COMMAND_RESULTS, RunFolder
from egvs.core.errors import InputError
from egvs.results.command_entries import DIGEST_KEY, design_digest, what_if_digest
from egvs.scenario.model import Scenario
from tests.report.small_runs import render_report, run_to_scores

STAGES = {"traffic": "", "tpog": ""}
"""Inputs of stages as in :func:`tests.report.small_runs.make_record`."""

BOX = {"x_m": 2.0, "y_m": 2.0, "length_m": 1.0, "width_m": 1.0, "height_m": 1.0}
TABLES = {"lorry": {"share": 0.25, "boxes": [BOX]}}


@pytest.fixture
def run(tmp_path: Path) -> tuple[Scenario, Path]:
    return run_to_scores(tmp_path, what_if=TABLES)


def write(path: Path, name: str, values: Mapping[str, Any], stages: Mapping[str, str] = STAGES) -> None:
    write_results(path, {name: CommandResult(stages, values)})


def section(text: str, name: str) -> str | None:
    """The text of a section without tags, white space as single spaces; None if the page has none."""
    match = re.search(rf'<section id="{name}">(.*?)</section>', text, re.DOTALL)
    if match is None:
        return None
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", match[1])).split())


def what_if_values(scenario: Scenario) -> dict[str, Any]:
    return {
        "share": 0.25, "best_before": "a1", "best_present": "b1", "best_expected": "b1",
        "change": {"value": -12.5, "se": 3.25, "better": 0.0}, "rival": "b1", "overtakes": 0.97,
        "conclusion": "lorry (25 % of the time): b1 becomes the best site instead of a1.",
        "tables": ["lorry"], DIGEST_KEY: what_if_digest(scenario, ["lorry"]),
    }  # fmt: skip


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


def test_shows_what_if(run: tuple[Scenario, Path]) -> None:
    scenario, out = run
    write(out / "what_if.json", "lorry", what_if_values(scenario))
    text = section(render_report(scenario, out), "what-if")
    assert text is not None
    assert "lorry 25 % a1 b1 b1 -12" in text
    assert "97 % (b1)" in text
    assert "b1 becomes the best site instead of a1." in text


def test_what_if_of_other_tables_is_not_shown(run: tuple[Scenario, Path]) -> None:
    scenario, out = run
    write(out / "what_if.json", "lorry", what_if_values(scenario))
    assert section(render_report(scenario, out), "what-if")
    changed = scenario.what_if["lorry"].model_copy(update={"share": 0.5})
    assert section(render_report(scenario.model_copy(update={"what_if": {"lorry": changed}}), out), "what-if") is None
    assert section(render_report(scenario.model_copy(update={"what_if": {}}), out), "what-if") is None


def test_what_if_digest_covers_contents_of_files(run: tuple[Scenario, Path]) -> None:
    scenario, _ = run
    table = scenario.what_if["lorry"].model_copy(update={"footprints": ("works.geojson",)})
    scenario = scenario.model_copy(update={"what_if": {"works": table}})
    assert what_if_digest(scenario, ["works"]) is None  # no such file
    (scenario.folder / "works.geojson").write_text("1")
    first = what_if_digest(scenario, ["works"])
    (scenario.folder / "works.geojson").write_text("2")
    assert None is not first != what_if_digest(scenario, ["works"])


def test_shows_sheet_with_its_link(run: tuple[Scenario, Path]) -> None:
    """3.456 m is 3.46 m; a bearing of 359.96 degrees is north; the pitch of the site is 0."""
    scenario, out = run
    site, pose = pose_of(out)
    write(out / "sheets.json", site, sheet_values(pose))
    page = render_report(scenario, out)
    text = section(page, "installation")
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
    assert section(page, "installation") is None
    assert section(page, "acceptance") is None


def test_shows_both_verdicts(run: tuple[Scenario, Path]) -> None:
    scenario, out = run
    site, pose = pose_of(out)
    write(out / "acceptance.json", site, accept_values(pose, "tilt is off by 1.5 degrees, limit 1", "x < y"))
    text = section(render_report(scenario, out), "acceptance")
    assert text is not None
    assert f"{site} small failed tilt is off by 1.5 degrees, limit 1; x < y" in text
    write(out / "acceptance.json", site, accept_values(pose))  # after it was corrected
    text = section(render_report(scenario, out), "acceptance")
    assert text is not None
    assert f"{site} small passed –" in text
    assert "failed" not in text


def test_shows_sensor_design(run: tuple[Scenario, Path]) -> None:
    scenario, out = run
    write(out / "sensor_design.json", "south", design_values(scenario))
    page = render_report(scenario, out)
    text = section(page, "sensor-design")
    assert text is not None
    assert "searched with 1,200 frames and scored with 1,300 others" in text
    assert "small 4.00 90.0 -10.0 81.0 % 80.2 ± 2.0 % +0.0 ± 1.0" in text
    assert "designed 4.00 90.0 -10.0 85.0 % 84.3 ± 2.0 % +4.1 ± 1.0" in text
    assert '<tr class="top"><th scope="row">designed' in page
    assert "One was left out." in text
    other = scenario.score.model_copy(update={"sampled_frames": scenario.score.sampled_frames + 1})
    assert section(render_report(scenario.model_copy(update={"score": other}), out), "sensor-design") is None


@pytest.mark.parametrize("file", [file.name for file in COMMAND_RESULTS])
def test_results_of_other_traffic_are_not_shown(run: tuple[Scenario, Path], file: str) -> None:
    """The page is the same, byte for byte, as without the file."""
    scenario, out = run
    before = render_report(scenario, out)
    site, pose = pose_of(out)
    values = {
        "what_if.json": what_if_values(scenario), "sheets.json": sheet_values(pose),
        "acceptance.json": accept_values(pose), "sensor_design.json": design_values(scenario),
    }  # fmt: skip
    write(out / file, site, values[file], {"traffic": "other inputs"})
    assert render_report(scenario, out) == before
    write(out / file, site, values[file], {"traffic": "", "score": ""})  # score was not recorded
    assert render_report(scenario, out) == before
    write(out / file, site, values[file])
    assert render_report(scenario, out) != before


def test_entries_of_other_names_stay(tmp_path: Path) -> None:
    path = RunFolder(tmp_path).sheets
    assert read_results(path) == {}
    write(path, "a", {"n": 1})
    write(path, "b", {"n": 2})
    write(path, "a", {"n": 3})
    assert {name: entry.values["n"] for name, entry in read_results(path).items()} == {"a": 3, "b": 2}


def test_changed_file_is_refused(tmp_path: Path) -> None:
    path = RunFolder(tmp_path).acceptance
    write(path, "a", {"passed": False})
    value = json.loads(path.read_text())
    value["entries"]["a"]["values"]["passed"] = True
    path.write_text(json.dumps(value))
    with pytest.raises(InputError, match=r"acceptance\.json: was changed: .* Remove it and repeat"):
        read_results(path)
    with pytest.raises(InputError, match="was changed"):
        write(path, "b", {"passed": True})
