"""From a downloaded map to an accepted installation: the commands of docs/story.md, one after the other."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.artefacts.traffic_frames import read_frames
from egvs.extensions.hardware.installation.planned_sites import PlannedSites
from egvs.formats import point_clouds
from tests.creation.overpass_server import overpass_server, recorded_answer, send
from tests.extensions.hardware.installation.simulated_scan import box, simulate_scan

PAGE = Path(__file__).parents[4] / "docs" / "story.md"
TILT_ERROR_DEG = 1.5


def page_commands() -> list[list[str]]:
    """The commands of the page, word by word."""
    lines = re.findall(r"^\$ egvs (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    return [line.split() for line in lines]


@pytest.mark.slow
@pytest.mark.system
def test_commands_of_the_page_lead_from_a_map_to_an_accepted_sensor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_egvs: Any
) -> None:
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    new, run, place, sheets, refused, accepted = page_commands()

    with overpass_server(send(recorded_answer())) as server:
        monkeypatch.setenv("EGVS_OVERPASS_URL", server.url)
        assert run_egvs(*new)[0] == 0
    assert len(server.queries) == 1
    assert run_egvs(*run)[0] == 0
    assert run_egvs(*place)[0] == 0
    folder = Path(run[run.index("--out") + 1])
    sites = PlannedSites.open(folder)
    (name,) = sites.default_sites
    assert name == refused[refused.index("--site") + 1]

    code, printed, _ = run_egvs(*sheets)
    assert (code, ": tilt " in printed) == (0, True)
    (sheet,) = (folder / "sheets").iterdir()
    assert sheet.read_bytes().startswith(b"%PDF")

    write_scans(sites, name)
    code, printed, _ = run_egvs(*refused)
    assert (code, re.search(r"failed: tilt is off by 1\.(4[5-9]|5)", printed) is not None) == (1, True), printed
    report = json.loads((folder / "acceptance" / f"acceptance_{name}.json").read_text())
    assert report["pose_error"]["tilt_deg"]["error"] == pytest.approx(TILT_ERROR_DEG, abs=0.1)
    code, printed, _ = run_egvs(*accepted)
    assert (code, "passed" in printed) == (0, True), printed


def write_scans(sites: PlannedSites, name: str) -> None:
    """Write a scan of the sensor with an error of its tilt, and one of the corrected mount; both with traffic."""
    site = sites.site(name)
    frames = read_frames(sites.run.work.folder.trajectories, np.array([40, 150]))
    for file, error_deg, frame in zip(("measured.pcd", "corrected.pcd"), (TILT_ERROR_DEG, 0.0), frames, strict=True):
        actual = replace(site.pose, pitch_deg=site.pose.pitch_deg + error_deg)
        cars = [box(row[:3], row[3:6], row[6]) for row in frame.boxes]
        points = simulate_scan(
            sites.session.scene, sites.sensor(site), site.pose, actual, boxes=cars, sigma_m=0.02, lost=0.05
        )  # fmt: skip
        point_clouds.write_points(Path(file), points)
