"""From a map to a plan by the calls of the page; the command line gives the same ranking, byte for byte."""

from __future__ import annotations

import contextlib
import http.client
import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from egvs.extensions.desk import jobs
from egvs.extensions.desk.jobs import start_worker
from tests.creation.overpass_server import overpass_server, recorded_answer
from tests.extensions.desk.conftest import MAP
from tests.extensions.desk.serving import Client
from tests.extensions.desk.test_aerial import middle_of_red, write_picture

pytestmark = [pytest.mark.system, pytest.mark.slow]


@contextmanager
def listening(desk: Client) -> Iterator[http.client.HTTPResponse]:
    """Receive events."""
    connection = http.client.HTTPConnection(desk.host, timeout=120)
    connection.request("GET", "/api/events", headers={"Cookie": desk.cookie})
    response = connection.getresponse()
    try:
        yield response
    finally:
        connection.close()


@contextmanager
def paused_run(desk: Client) -> Iterator[int]:
    """Start a run whose worker is paused before it does anything; yields its number."""
    workers = []

    def start_paused(request: dict[str, Any]) -> subprocess.Popen[str]:
        process = start_worker(request)
        os.kill(process.pid, signal.SIGSTOP)
        workers.append(process.pid)
        return process

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jobs, "start_worker", start_paused)
        desk.ok("POST", "/api/run", {})
    (worker,) = workers
    try:
        yield worker
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(worker, signal.SIGCONT)


def next_event(events: http.client.HTTPResponse, name: str) -> dict[str, object]:
    while True:
        if events.readline().decode().strip() == f"event: {name}":
            content: dict[str, object] = json.loads(events.readline().removeprefix(b"data: "))
            return content


def test_a_map_is_downloaded_around_a_point(desk: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def respond(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.end_headers()
        handler.wfile.write(recorded_answer())

    with overpass_server(respond) as server:
        monkeypatch.setenv("EGVS_OVERPASS_URL", server.url)
        desk.ok("POST", "/api/maps/download", {"lat_deg": "52,0", "lon_deg": 10})
        downloaded = desk.wait()["result"]["map"]
    assert len(server.queries) == 1
    desk.ok("POST", f"/api/maps/{downloaded}/read", {})
    desk.wait()
    streets = desk.ok("GET", f"/api/maps/{downloaded}")["streets"]
    assert streets["junctions"][0]["title"] == "signalised junction of East Street and North Street"
    assert streets["attribution"] == "(c) OpenStreetMap contributors, ODbL"
    assert desk.refused("POST", "/api/maps/download", {"lat_deg": "91", "lon_deg": 10})[::2] == (422, "lat_deg")


def test_from_a_map_to_a_plan(desk: Client, tmp_path: Path) -> None:
    dropped = desk.ok("POST", "/api/maps?name=town.osm", MAP.read_bytes())
    desk.ok("POST", f"/api/maps/{dropped['id']}/read", {})
    desk.wait()
    streets = desk.ok("GET", f"/api/maps/{dropped['id']}")["streets"]
    junction = streets["junctions"][0]
    assert (junction["title"], junction["arms"]) == ("signalised junction of East Street and North Street", 4)
    picture = write_picture(tmp_path / "aerial.tif", *junction["at"][::-1]).read_bytes()
    shown = desk.ok("POST", f"/api/maps/{dropped['id']}/aerial?name=aerial.tif", picture)
    _, _, content = desk.raw("GET", f"/api/maps/{dropped['id']}/aerial")
    at_m = [junction["x_m"], junction["y_m"]]
    assert middle_of_red(content, shown["aerial"]["matrix"]) == pytest.approx(at_m, abs=0.5)
    request = {"map": dropped["id"], "name": "town", "at": junction["at"], "poles": "existing"}
    desk.ok("POST", "/api/new", request)
    assert desk.wait()["result"]["notes"]
    assert desk.project["aerial"]["matrix"] != shown["aerial"]["matrix"]  # in the frame of the scenario
    assert desk.refused("POST", "/api/new", request)[::2] == (409, "name")

    desk.ok("POST", "/api/sites", {"x_m": "211,5", "y_m": 211})
    desk.ok("PUT", "/api/counts", {"counts": {"0": 300, "7": "280"}})
    desk.ok("PUT", "/api/settings", {"frames": 60, "warmup_s": 20, "heights_m": [4, 6], "pitch_deg": [-5]})
    desk.ok("POST", "/api/run", {})
    job = desk.wait()
    assert any(line.startswith("score") for line in job["log"] if line) or job["state"] == "done"

    ranking = desk.ok("GET", "/api/ranking")
    assert sorted(pole["pole"] for pole in ranking["poles"]) == ["lamp1", "new1", "signal1"]
    assert not ranking["outdated"]
    assert any("60 frames" in warning for warning in ranking["warnings"])
    traffic = desk.ok("GET", "/api/traffic")
    assert (len(traffic["moments"]), traffic["first_s"], traffic["period_s"]) == (60, 0.0, 1.0)
    recorded = pq.read_table(tmp_path / "work" / "runs" / "town" / "trajectories.parquet").to_pylist()
    for number, moment in enumerate(traffic["moments"]):
        rows = [row for row in recorded if row["frame"] == number]
        keys = ("x_m", "y_m", "yaw_rad", "length_m", "width_m")
        expected = sorted([row[key] for key in keys] for row in rows)
        assert np.allclose(sorted(moment), expected, atol=0.0051) if expected else not moment
    command = [sys.executable, "-m", "egvs", "run", "town", "--out", str(tmp_path / "again")]
    subprocess.run(command, cwd=tmp_path / "work", check=True, capture_output=True)
    scores = [folder / "scores.parquet" for folder in (tmp_path / "work" / "runs" / "town", tmp_path / "again")]
    assert scores[0].read_bytes() == scores[1].read_bytes()

    desk.ok("POST", "/api/plan", {"count": "2"})
    desk.wait()
    plan = desk.ok("GET", "/api/plan")
    assert (len(plan["sensors"]), plan["requested"]) == (2, {"count": 2})
    assert 0.9 < plan["certificate"] <= 1
    assert all(sensor["adds_text"] for sensor in plan["sensors"])
    assert re.match(r"The plan of 2 sensors should find \d+", plan["headline"])
    desk.ok("POST", "/api/plan", {"count": 99})
    assert "at most" in desk.wait("failed")["message"]

    trajectories = tmp_path / "work" / "runs" / "town" / "trajectories.parquet"
    kept = trajectories.read_bytes()
    trajectories.write_bytes(kept[:100])
    assert desk.refused("GET", "/api/traffic")[0] == 409
    trajectories.write_bytes(kept)

    for name, begin in (("gpkg", b"SQLite"), ("sheets", b"PK"), ("csv", b"PK")):
        desk.ok("POST", f"/api/downloads/{name}", {})
        url = desk.wait()["result"]["url"]
        _, headers, content = desk.raw("GET", url)
        assert content.startswith(begin)
        assert headers["content-disposition"].startswith("attachment")
    _, _, packed = desk.raw("GET", "/api/files/scenario")
    assert {"scenario.toml", "sites.csv", "counts.csv"} <= set(zipfile.ZipFile(io.BytesIO(packed)).namelist())
    assert desk.ok("POST", "/api/import?name=sent.zip", packed)["project"]["id"] == "sent"
    assert (tmp_path / "work" / "sent" / "sites.csv").read_bytes() == (
        tmp_path / "work" / "town" / "sites.csv"
    ).read_bytes()


def test_a_run_is_stopped_and_continued_and_becomes_outdated(desk: Client, tmp_path: Path) -> None:
    desk.ok("POST", "/api/open", {"scenario": "mini"})
    assert desk.refused("GET", "/api/ranking")[0] == 404
    assert desk.refused("GET", "/api/traffic")[0] == 409
    for path in ("/api/score", "/api/three"):
        assert desk.refused("POST", path, {"site": "pole_a"})[0] == 409
    with listening(desk) as events:
        with paused_run(desk) as worker:  # it cannot end meanwhile
            assert desk.refused("POST", "/api/run", {})[0] == 409
            assert desk.refused("PATCH", "/api/sites/pole_a", {"z_m": 4})[0] == 409
            threading.Timer(1.0, os.kill, (worker, signal.SIGCONT)).start()  # finds the signal to stop
            assert desk.ok("POST", "/api/stop", {})["job"]["state"] == "stopped"
        assert next_event(events, "job")["state"] == "runs"
        assert desk.refused("POST", "/api/stop", {})[0] == 409
        desk.ok("POST", "/api/run", {})
        desk.wait()
        assert desk.project["run"]["state"] == "complete"

        move = {"x_m": 11, "keep_results": True}
        status, message, field = desk.refused("PATCH", "/api/sites/pole_a", dict(move))
        assert (status, field) == (409, "keep_results") and "present poles and counts" in message
        assert (desk.project["run"]["state"], desk.project["undo"]) == ("complete", None)
        desk.ok("PATCH", "/api/sites/pole_a", {"must_not": True, "keep_results": True})  # no score depends on it
        desk.ok("POST", "/api/undo", {"keep_results": True})
        desk.ok("PATCH", "/api/sites/pole_a", {**move, "keep_results": False})
        assert desk.project["run"]["state"] == "outdated"
        assert desk.ok("GET", "/api/ranking")["outdated"]
        desk.ok("POST", "/api/undo", {"keep_results": True})
        assert desk.project["run"]["state"] == "complete"
        desk.ok("POST", "/api/redo", {"keep_results": True})  # that was agreed to
        desk.ok("POST", "/api/undo", {})

        desk.ok("PATCH", "/api/sites/pole_b", {"must": True})
        assert desk.project["run"]["state"] == "complete"
        lorry = {"name": "lorry1", "x_m": 20, "y_m": 5, "yaw_deg": 0, "length_m": 12, "width_m": 2.5, "height_m": 3.8}
        desk.ok("PUT", "/api/obstacles", {"obstacles": [lorry]})
        assert desk.refused("GET", "/api/what_if")[0] == 404
        desk.ok("POST", "/api/what_if", {})
        desk.wait()
        compared = desk.ok("GET", "/api/what_if")
        assert not compared["outdated"] and "of the time" in compared["text"][0]
        assert {row["site"].partition(",")[0] for row in compared["sites"]} == {"pole_a", "pole_b"}
        assert re.search(r": pole_[ab], [\d.]+ m up, level (stays|becomes) the best site", compared["text"][0])
        desk.ok("PUT", "/api/obstacles", {"obstacles": []})
        assert desk.ok("GET", "/api/what_if")["outdated"]
        desk.ok("POST", "/api/plan", {"count": 1})
        desk.wait()
        assert [each["pole"] for each in desk.ok("GET", "/api/plan")["sensors"]] == ["pole_b"]
        assert not desk.project["run"]["plan_outdated"]
        (adds,) = desk.ok("GET", "/api/plan")["sensors"][0]["adds_text"]
        assert re.fullmatch(r"Vehicles that only this sensor finds: \d+ % of all vehicles\.", adds)
        desk.ok("POST", "/api/additions", {})
        desk.wait()
        assert desk.ok("GET", "/api/plan")["sensors"][0]["adds_text"] == [adds]

        desk.ok("PUT", "/api/obstacles", {"obstacles": [lorry]})
        desk.ok("POST", "/api/what_if", {})
        desk.wait()
        assert re.match(
            r"With obstacles, the plan of 1 sensor changes from [\d,]+ ± [\d,]+ bit to [\d,]+ ± [\d,]+ bit "
            r"\(by -?[\d,]+ ± [\d,]+ bit\)\.$", desk.ok("GET", "/api/what_if")["text"][0],
        )  # fmt: skip
        desk.ok("PUT", "/api/obstacles", {"obstacles": []})
        assert not desk.project["run"]["plan_outdated"]

        digest = desk.project["files"]
        desk.ok("POST", "/api/trial", {"site": "pole_b", "sensor": "VLP-16"})
        tried = desk.wait()["result"]
        assert (tried["site"], tried["sensor"], tried["label"]) == ("pole_b", "VLP-16", "EGVS")
        assert (
            re.fullmatch(r"\+[\d,]+ ± [\d,]+ bit", tried["change_text"]) and tried["before_text"] != tried["after_text"]
        )
        desk.ok("POST", "/api/trial", {"site": "pole_a", "sensor": "VLP-16"})
        assert "sensors are these already" in desk.wait("failed")["message"]
        assert desk.refused("POST", "/api/trial", {"site": "pole_b", "sensor": "none"})[::2] == (422, "sensor")
        assert desk.refused("POST", "/api/trial", {"site": "pole_c", "sensor": "VLP-16"})[0] == 404
        assert desk.project["files"] == digest
        desk.ok("PATCH", "/api/sites/pole_b", {"must": False})
        assert desk.project["run"]["plan_outdated"]
        assert desk.refused("POST", "/api/trial", {"site": "pole_b", "sensor": "VLP-16"})[0] == 409

        before = (tmp_path / "work" / "runs" / "mini" / "scores.parquet").read_bytes()
        for number in range(3):
            desk.ok("POST", "/api/score", {"site": "pole_a", "x_m": 10 + number / 10, "request": number})
        while (answer := next_event(events, "score"))["request"] != 2:
            assert answer["ok"]
        assert answer["ok"] and answer["rank"] in (1, 2)
        desk.ok("PATCH", "/api/sites/pole_a", {"x_m": 11})  # the ranking is that of the run all the same
        desk.ok("POST", "/api/score", {"site": "pole_a", "x_m": 16, "y_m": 6, "request": 3})
        refused = next_event(events, "score")
        assert not refused["ok"] and "house" in str(refused["message"])
        assert desk.project["run"]["state"] == "outdated"
        assert (tmp_path / "work" / "runs" / "mini" / "scores.parquet").read_bytes() == before

        desk.ok("POST", "/api/plan", {"count": 2})  # of the moved pole: the ranking follows
        desk.wait()
        assert (desk.project["run"]["state"], desk.ok("GET", "/api/plan")["outdated"]) == ("complete", False)
        assert not desk.ok("GET", "/api/ranking")["outdated"]
        desk.ok("POST", "/api/undo", {"keep_results": False})
        assert (desk.project["run"]["state"], desk.ok("GET", "/api/ranking")["outdated"]) == ("outdated", True)


def test_mistakes_with_maps_are_explained(desk: Client) -> None:
    dropped = desk.ok("POST", "/api/maps?name=broken.osm", b"<osm><script>alert(1)</script>")
    desk.ok("POST", f"/api/maps/{dropped['id']}/read", {})
    message = desk.wait("failed")["message"]
    assert "broken.osm" in message and "/upload" not in message
    assert desk.ok("GET", f"/api/maps/{dropped['id']}")["message"] == message
    bare = (
        MAP.read_bytes()
        .replace(b'v="street_lamp"', b'v="x"')
        .replace(b'k="highway" v="traffic_signals"', b'k="x" v="x"')
    )
    dropped = desk.ok("POST", "/api/maps?name=bare.osm", bare)
    desk.ok("POST", "/api/new", {"map": dropped["id"], "name": "bare", "at": None, "poles": "existing"})
    made = desk.wait()["result"]
    assert made["note"].startswith("The candidates are new poles at the kerbs: no map has a street lamp")
    assert made["note"] == made["notes"][0] == desk.project["notes"][0]
    assert desk.project["sites"] and not any(site["exists"] for site in desk.project["sites"])
    for body, field in (
        ({"map": "m9", "name": "x"}, ""), ({"map": dropped["id"], "name": "../x"}, "name"),
        ({"map": dropped["id"], "name": "x", "at": [1]}, "at"),
        ({"map": dropped["id"], "name": "x", "at": ["a", "b"]}, "at"),
        ({"map": dropped["id"], "name": "x", "poles": "all"}, "poles"),
        ({"map": dropped["id"], "name": "x", "traffic": "none"}, "traffic"),
    ):  # fmt: skip
        assert desk.refused("POST", "/api/new", body)[2] == field


def test_ends_with_its_jobs(tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    program = subprocess.Popen(
        [sys.executable, "-m", "egvs", "desk", str(tmp_path / "work"), "--no-browser"], stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert program.stdout is not None
    desk = Client(program.stdout.readline().split()[0])
    dropped = desk.ok("POST", "/api/maps?name=town.osm", MAP.read_bytes())
    desk.ok("POST", f"/api/maps/{dropped['id']}/read", {})
    with listening(desk) as events:  # as an open page does
        assert next_event(events, "state")
        program.terminate()
        begin_s = time.monotonic()
        _, errors = program.communicate(timeout=60)
    assert time.monotonic() - begin_s < 30
    assert errors == ""
