"""The commands that pages quote: :data:`SESSIONS`."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from tests.creation.overpass_server import overpass_server, recorded_answer, send
from tests.extensions.hardware.installation.simulated_scan import box, simulate_scan

from benchmarks.docs_figures.printed import DOCS, Session, block_of, run_command, run_commands
from egvs.artefacts.traffic_frames import read_frames
from egvs.extensions.hardware.installation.planned_sites import PlannedSites
from egvs.formats import point_clouds

TILT_ERROR_DEG = 1.5
POLE_M = 0.6
"""Distance of the pole that stands before the sensor in ``blocked.pcd``."""

PLAN = """phase,approach,movement,green_s,yellow_s,all_red_s
1,north,all,60,3,2
1,south,all,60,3,2
2,east,all,12,3,2
2,west,all,12,3,2
"""


def run_story(session: Session, folder: Path) -> list[str]:
    """Run the commands of docs/story.md: a local server answers as recorded, and scans are simulated."""
    with overpass_server(send(recorded_answer())) as server:
        environment = {"EGVS_OVERPASS_URL": server.url, "XDG_CACHE_HOME": str(folder / "cache")}
        environment |= {name: "" for name in os.environ if name.lower() in ("http_proxy", "all_proxy")}
        outputs = []
        for command in session.commands:
            words = command.split(" ")
            if "plan.csv" in command:
                (folder / "crossing" / "plan.csv").write_text(PLAN, encoding="utf-8")
            if words[1] == "accept" and not (folder / "measured.pcd").exists():
                write_scans(folder, words[words.index("--site") + 1])
            is_refused = words[1] == "accept" and words[-1] != "corrected.pcd"
            text = run_command(command, folder, environment, code=int(is_refused))
            outputs.append(text.replace(urlsplit(server.url).netloc, "overpass-api.de"))
    return outputs


def write_scans(folder: Path, name: str) -> None:
    """Write three scans of a planned site with traffic: tilted, corrected, and tilted with a pole in front of it."""
    sites = PlannedSites.open(folder / "run")
    site = sites.site(name)
    frames = read_frames(sites.run.work.folder.trajectories, np.array([40, 150, 150]))
    files = (("measured", TILT_ERROR_DEG, False), ("corrected", 0.0, False), ("blocked", TILT_ERROR_DEG, True))
    for (file, error_deg, is_blocked), frame in zip(files, frames, strict=True):
        actual = replace(site.pose, pitch_deg=site.pose.pitch_deg + error_deg)
        solids = [box(row[:3], row[3:6], row[6]) for row in frame.boxes]
        if is_blocked:
            x_m, y_m, z_m = site.pose.position_m
            yaw_rad = np.radians(site.pose.yaw_deg + 20.0)
            at_m = x_m + POLE_M * np.cos(yaw_rad), y_m + POLE_M * np.sin(yaw_rad), z_m
            solids.append(box(at_m, (0.15, 0.15, 4.0)))
        points = simulate_scan(
            sites.session.scene, sites.sensor(site), site.pose, actual, boxes=solids, sigma_m=0.02, lost=0.05
        )  # fmt: skip
        point_clouds.write_points(folder / f"{file}.pcd", points)


def run_what_if(session: Session, folder: Path) -> list[str]:
    """Run what-if with the tables of docs/certainty.md at nishishinjuku."""
    page, junction = DOCS / "certainty.md", folder / "junction"
    junction.mkdir()
    text = 'extends = "../scenarios/nishishinjuku"\n\n' + block_of(page, "[what_if.")
    (junction / "scenario.toml").write_text(text, encoding="utf-8")
    (junction / "deliveries.csv").write_text(block_of(page, "x_m,y_m,yaw_deg,type"), encoding="utf-8")
    return run_commands(session, folder)


SESSIONS: tuple[Session, ...] = (
    Session("demo", ("egvs demo", "egvs place scenarios/demo --count 4"), results="egvs-demo/results", is_quick=True),
    Session(
        "story",
        (
            "egvs new crossing --at 52.0,10.0 --download --vehicles-per-hour 530",
            "egvs run crossing --set traffic.frames=300 --out run",
            "egvs place crossing --set traffic.frames=300 --set placement.count=1 --out run",
            "egvs sheets run",
            "egvs accept run --site k03@3m-5deg --scan measured.pcd",
            "egvs accept run --site k03@3m-5deg --scan corrected.pcd",
            "egvs accept run --site k03@3m-5deg --scan blocked.pcd",
            "egvs run crossing --set traffic.frames=300 --set "
            """'traffic.signals={"East Street / North Street"={file="plan.csv"}}' --out fixed_plan""",
        ),
        run_story,
        results="run",
    ),
    Session(
        "nishishinjuku",
        ("egvs run scenarios/nishishinjuku", "egvs place scenarios/nishishinjuku --count 2"),
        results="runs/nishishinjuku",
    ),
    Session("what-if", ("egvs what-if junction --set traffic.frames=300",), run_what_if),
    Session(
        "sensor-design",
        (
            "egvs sensor design scenarios/nishishinjuku --pole c05 --sensors VLP-16,VLP-32C,OS1-128 --heights 2,6 "
            "--channels 32 --set traffic.frames=1200",
        ),
    ),
    Session("validate", ("egvs validate scenarios/demo --frames 60 --detector cluster",)),
)


def session_of(name: str) -> Session:
    """Return the session of a name."""
    return next(session for session in SESSIONS if session.name == name)
