"""The desk's server: one open scenario for all tabs, and the calls of the page.

Each call is a method of :class:`Desk` that takes the body of a request and returns the answer in JSON. Calls run in
threads, one change at a time; what takes long is a job (:mod:`egvs.extensions.desk.jobs`).
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import shutil
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from egvs.artefacts.run_folder import RunFolder
from egvs.core.errors import EgvsError, InputError
from egvs.creation.assumed_traffic import TRAFFIC_LEVELS
from egvs.extensions.desk import aerial, downloads, obstacles, results_view
from egvs.extensions.desk.aerial import AerialPicture
from egvs.extensions.desk.events import Events
from egvs.extensions.desk.jobs import Job, LiveScores, ask_worker
from egvs.extensions.desk.project import KEEP_RESULTS, Project
from egvs.extensions.desk.refusals import RefusalError, parse_number, require_text
from egvs.extensions.desk.workspace import DroppedMap, Workspace, map_suffixes
from egvs.results.ranking import Ranking

STATIC = Path(__file__).parent / "static"
_TYPES = {
    ".html": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8", ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml", ".png": "image/png", ".jpg": "image/jpeg",
}  # fmt: skip

MAX_BODY_BYTES = 1_000_000
MAX_UPLOAD_BYTES = 256 << 20
_LOOK_EVERY_S = 2.0
"""How often files are looked at that may be edited by hand."""

Body = dict[str, Any]
Answer = dict[str, Any]


class Desk:
    """The state of the server.

    Parameters
    ----------
    workspace
        The folder.
    """

    def __init__(self, workspace: Workspace) -> None:
        self.workspace = workspace
        self.events = Events()
        self._project: Project | None = None
        self._job: Job | None = None
        self._live = LiveScores(self.events.publish)
        self._revision = 0
        self._three: tuple[subprocess.Popen[str], str] | None = None
        self._what_if: tuple[str, Answer] | None = None
        self._additions: tuple[object, dict[str, list[str]]] = (None, {})
        self._lock = threading.RLock()

    def close(self) -> None:
        """End all processes."""
        self._close_run()
        if self._job is not None and self._job.is_running:
            self._job.stop()

    @property
    def project(self) -> Project:
        """The open scenario; RefusalError if none is open."""
        if self._project is None:
            raise RefusalError(409, "No scenario is open.", "Open one on the first page.")
        return self._project

    def look_at_files(self) -> None:
        """Tell the pages if files were edited by hand."""
        if self._project is not None and self._project.refresh():
            self._publish_state()

    def _publish_state(self) -> None:
        self._revision += 1
        self.events.publish("state", {"revision": self._revision})

    def first_event(self) -> Answer:
        """Return the content of the first event of a page."""
        return {"revision": self._revision}

    # ---- state and the start page

    def state(self, _body: Body) -> Answer:
        """Return everything that the page shows of the open scenario."""
        project = None if self._project is None else self._project.to_json()
        job = None if self._job is None else self._job.to_json(with_log=True)
        return {"revision": self._revision, "job": job, "project": project}

    def start(self, _body: Body) -> Answer:
        """Return what the start page lists."""
        return {**self.workspace.describe(), "max_upload_bytes": MAX_UPLOAD_BYTES}

    def open(self, body: Body) -> Answer:
        """Open a scenario."""
        return self._open(require_text(body, "scenario"))

    def _open(self, identifier: str) -> Answer:
        with self._lock:
            self._refuse_while_running()
            self._open_project(identifier)
            return self.state({})

    def _open_project(self, identifier: str, notes: Sequence[str] = ()) -> None:
        folder = self.workspace.scenario_folder(identifier)
        project = Project(identifier, folder, self.workspace.run_folder(folder.name), list(notes))
        project.run_folder = self.workspace.run_folder(project.scenario.name)
        self._project = project
        self._close_run()
        self._publish_state()

    def copy(self, body: Body) -> Answer:
        """Copy a shipped scenario, and open it."""
        name = require_text(body, "name")
        self.workspace.copy_shipped(require_text(body, "shipped"), name)
        return self._open(name)

    def close_project(self, _body: Body) -> Answer:
        """Go back to the start page."""
        with self._lock:
            self._refuse_while_running()
            self._project = None
            self._close_run()
            self._publish_state()
            return self.state({})

    # ---- maps and new scenarios

    def _map(self, identifier: str) -> DroppedMap:
        if identifier not in self.workspace.maps:
            raise RefusalError(404, f"there is no map {identifier[:20]!r}")
        return self.workspace.maps[identifier]

    def show_map(self, _body: Body, identifier: str) -> Answer:
        """Return a dropped map, with its streets if they were read."""
        return self._map(identifier).to_json(with_streets=True)

    def read_map(self, _body: Body, identifier: str) -> Answer:
        """Read the streets of a map: a job."""
        dropped = self._map(identifier)

        def finish(_result: Answer) -> Answer:
            dropped.state = "read"
            return {"map": identifier}

        def fail(reason: str) -> None:
            dropped.state, dropped.message = "failed", reason

        request = {"map": str(dropped.path), "out": str(dropped.streets), "names": {str(dropped.path): dropped.name}}
        with self._lock:
            self._refuse_while_running()
            dropped.state, dropped.message = "reading", ""
            return self._start_job("junctions", f"Read {dropped.name}", request, finish, fail)

    def download_map(self, body: Body) -> Answer:
        """Download the map around a point: a job. Nothing is downloaded otherwise."""
        at = [parse_number(body.get(key), key, -limit, limit) for key, limit in (("lat_deg", 85.0), ("lon_deg", 180.0))]
        path = self.workspace.begin_upload("map.osm", (".osm",))

        def finish(_result: Answer) -> Answer:
            return {"map": self.workspace.add_map(f"{at[0]:.5f},{at[1]:.5f}.osm", path).identifier}

        return self._start_job("download", "Download", {"at": at, "out": str(path)}, finish)

    def new(self, body: Body) -> Answer:
        """Make a scenario from a map: a job."""
        dropped = self._map(str(body.get("map")))
        name = require_text(body, "name")
        folder = self.workspace.new_folder(name)
        at = body.get("at")
        if at is not None:
            if not isinstance(at, list) or len(at) != 2:
                raise RefusalError(422, "expected two numbers", "Choose a junction.", "at")
            at = [parse_number(part, "at") for part in at]
        poles, traffic = body.get("poles", "existing"), body.get("traffic", "medium")
        if poles not in ("existing", "kerbs"):
            raise RefusalError(422, "expected existing or kerbs", "", "poles")
        if traffic not in TRAFFIC_LEVELS:
            raise RefusalError(422, f"expected one of {', '.join(TRAFFIC_LEVELS)}", "", "traffic")

        def finish(result: Answer) -> Answer:
            self._open_project(name, result["notes"])
            if dropped.picture is not None:
                with contextlib.suppress(InputError):  # it shows other junctions of the map
                    self.project.save_picture(dropped.picture)
                    self._publish_state()
            return result

        request = {
            "map": str(dropped.path), "folder": str(folder), "at": at, "poles": poles, "traffic": traffic,
            "walk": body.get("walk") is True, "names": {str(dropped.path): dropped.name},
        }  # fmt: skip
        return self._start_job("new", f"New scenario {name}", request, finish)

    # ---- aerial pictures

    def add_picture(self, picture: AerialPicture, identifier: str = "") -> Answer:
        """Take over an aerial picture for a dropped map, or for the open scenario, if the identifier is empty."""
        folder = picture.path.parent
        try:
            if identifier:
                self._map(identifier).save_picture(picture)
                return self.show_map({}, identifier)
            self.project.save_picture(picture)
        except BaseException:
            shutil.rmtree(folder)
            raise
        shutil.rmtree(folder)
        self._publish_state()
        return self.state({})

    def remove_picture(self, _body: Body) -> Answer:
        """Remove the aerial picture of the open scenario."""
        aerial.remove_picture(self.project.folder)
        self._publish_state()
        return self.state({})

    def picture(self, identifier: str = "") -> Path:
        """Return the aerial picture of a dropped map, or of the open scenario."""
        path = aerial.find_picture(self._map(identifier).path.parent if identifier else self.project.folder)
        if path is None:
            raise RefusalError(404, "there is no aerial picture")
        return path

    # ---- changes

    def _changed(self, body: Body, change: Callable[[], object]) -> Answer:
        with self._lock:
            self._refuse_while_running()
            self.project.protect_results(body.pop(KEEP_RESULTS, None))
            change()
            self._publish_state()
            return self.state({})

    def add_site(self, body: Body) -> Answer:
        """Add a pole."""
        names: list[str] = []
        answer = self._changed(body, lambda: names.append(self.project.add_site(body)))
        return {**answer, "site": names[0]}

    def edit_site(self, body: Body, name: str) -> Answer:
        """Change a pole."""
        return self._changed(body, lambda: self.project.edit_site(name, body))

    def remove_site(self, body: Body, name: str) -> Answer:
        """Remove a pole."""
        return self._changed(body, lambda: self.project.remove_site(name))

    def check_site(self, body: Body) -> Answer:
        """Say whether a pole can stand somewhere."""
        problem = self.project.check_pole(body)
        return {"ok": not problem, "message": problem}

    def set_counts(self, body: Body) -> Answer:
        """Set counts."""
        return self._changed(body, lambda: self.project.set_counts(body))

    def set_signals(self, body: Body) -> Answer:
        """Set the times of a signal."""
        return self._changed(body, lambda: self.project.set_signals(body))

    def set_obstacles(self, body: Body) -> Answer:
        """Set what could stand in the way."""
        return self._changed(body, lambda: self.project.set_obstacles(body))

    def set_settings(self, body: Body) -> Answer:
        """Set keys of the scenario."""
        return self._changed(body, lambda: self.project.set_settings(body))

    def undo(self, body: Body) -> Answer:
        """Undo the last change."""
        return self._changed(body, self.project.step_back)

    def redo(self, body: Body) -> Answer:
        """Do it again."""
        return self._changed(body, self.project.step_forward)

    def show_scene(self, _body: Body) -> Answer:
        """Return the map around the junction."""
        return self.project.map()

    def suggestions(self, _body: Body) -> Answer:
        """Return free positions along the kerbs."""
        return self.project.suggestions()

    def check(self, _body: Body) -> Answer:
        """Return the findings of ``egvs check``."""
        from egvs.stages.check import check_scenario

        report = check_scenario(self.project.scenario)
        findings = {"errors": report.errors, "warnings": report.warnings}
        return {
            key: [{"where": each.where, "problem": each.problem, "hint": each.hint} for each in found]
            for key, found in findings.items()
        }

    # ---- jobs

    def _refuse_while_running(self) -> None:
        if self._job is not None and self._job.is_running:
            title = self._job.to_json()["title"]
            raise RefusalError(409, f"{title} is at work.", "Wait until it has ended, or stop it.")

    def _start_job(
        self, kind: str, title: str, request: Answer, finish: Callable[[Answer], Answer] = dict,
        fail: Callable[[str], None] = lambda _: None,
    ) -> Answer:  # fmt: skip
        with self._lock:
            self._refuse_while_running()
            number = 1 if self._job is None else self._job.to_json()["id"] + 1
            request = {"cwd": str(self.workspace.folder), **request}
            self._job = Job(number, kind, title, request, self.events.publish, finish, fail)
            self.events.publish("job", self._job.to_json())
            return {"job": self._job.to_json()}

    def stop(self, _body: Body) -> Answer:
        """Stop the job."""
        if self._job is None or not self._job.is_running:
            raise RefusalError(409, "Nothing is at work.")
        self._job.stop()
        self._publish_state()
        return {"job": self._job.to_json()}

    @property
    def _folders(self) -> Answer:
        return {"scenario": str(self.project.folder), "run": str(self.project.run_folder)}

    def _finish_run(self, result: Answer) -> Answer:
        self._publish_state()
        return result

    def run(self, _body: Body) -> Answer:
        """Run all stages; continues a run that was stopped."""
        self._close_run()
        return self._start_job("run", "Run", self._folders, self._finish_run)

    def plan(self, body: Body) -> Answer:
        """Plan several sensors."""
        given = [key for key in ("count", "budget") if body.get(key) not in (None, "")]
        if len(given) != 1:
            raise RefusalError(422, "expected a number of sensors, or a budget", "", "count")
        (key,) = given
        number = parse_number(body[key], key, 1.0 if key == "count" else 0.01, 1000.0 if key == "count" else 1e9)
        if key == "count" and number != int(number):
            raise RefusalError(422, "expected a whole number of sensors", "", key)
        request = {**self._folders, "request": [f"placement.{key}={number:.12g}"]}
        return self._start_job("plan", "Plan", request, self._finish_plan)

    def _finish_plan(self, result: Answer) -> Answer:
        self._additions = self._plan_made, result["adds"]
        return self._finish_run({})

    @property
    def _plan_made(self) -> tuple[Path, int]:
        """The file of the plan, and when it was made."""
        path = RunFolder(self.project.run_folder).placement
        return path, path.stat().st_mtime_ns if path.is_file() else 0

    def _current_plan(self) -> Answer:
        """Return what a job about the plan needs; RefusalError if it does not belong to the present files."""
        self.project.refresh()
        state = self.project.run_state()
        if not state["has_plan"] or state["plan_outdated"]:
            raise RefusalError(409, "There is no plan of the present files.", "Find the plan first.")
        return self._folders

    def additions(self, _body: Body) -> Answer:
        """Say what each sensor of a plan adds that was made elsewhere: a job."""
        return self._start_job("additions", "Compare the sensors", self._current_plan(), self._finish_plan)

    def trial(self, body: Body) -> Answer:
        """Score the plan with another sensor on one pole: a job, which changes nothing."""
        request = self._current_plan()
        site, sensor = require_text(body, "site"), require_text(body, "sensor")
        settings = self.project.exchange_sensor(site, sensor, self.workspace.scratch / "trial.csv")
        request |= {"settings": settings}
        return self._start_job("trial", "Trial", request, lambda result: {**result, "site": site, "sensor": sensor})

    def what_if(self, _body: Body) -> Answer:
        """Compare the ranking with that with the obstacles: a job."""
        self._finished_run()
        if not self.project.obstacles:
            raise RefusalError(409, "There is no obstacle.", "Drop one on the map.")
        digest = self.project.digest

        def finish(result: Answer) -> Answer:
            self._what_if = digest, result
            return {}

        request = {"scenario": str(self.project.folder), "table": obstacles.TABLE}
        return self._start_job("what_if", "What if", request, finish)

    def show_what_if(self, _body: Body) -> Answer:
        """Return what the obstacles change."""
        if self._what_if is None:
            raise RefusalError(404, "Nothing was compared yet.", "Ask what changes.")
        digest, result = self._what_if
        return {"outdated": digest != self.project.digest, **result}

    def _finished_run(self) -> Path:
        if self.project.run_state()["state"] not in ("complete", "outdated"):
            raise RefusalError(409, "There is no finished run.", "Run the scenario first.")
        return self.project.run_folder

    def ranking(self, _body: Body) -> Answer:
        """Return the ranking."""
        if self.project.run_state()["state"] not in ("complete", "outdated"):
            raise RefusalError(404, "There is no ranking yet.", "Run the scenario first.")
        outdated = self.project.run_state()["state"] == "outdated"
        return {"outdated": outdated, **results_view.describe_ranking(self.project.run_folder)}

    def show_traffic(self, _body: Body) -> Answer:
        """Return some moments of the recorded traffic."""
        return ask_worker({"kind": "traffic", "run": str(self._finished_run())})

    def show_plan(self, _body: Body) -> Answer:
        """Return the plan."""
        made, adds = self._additions
        plan = results_view.describe_plan(
            self.project.run_folder, self.project.scenario, adds if made == self._plan_made else {}
        )
        if plan is None:
            raise RefusalError(404, "There is no plan yet.", "Ask for a number of sensors, or give a budget.")
        return {"outdated": self.project.run_state()["plan_outdated"], **plan}

    def _refuse_without_scores(self, *, is_open: bool) -> None:
        """Refuse where the run is not that of the files; what has it open goes on when poles were moved."""
        state = self.project.run_state()
        is_moved = is_open and set(state["changed"]) <= {self.project.sites_file}
        if state["state"] != "complete" and not is_moved:
            raise RefusalError(409, "Scores need a run of the present files.", "Run the scenario first.")

    def score(self, body: Body) -> Answer:
        """Ask for the score of a moved sensor; the answer is an event.

        Scores are those of the run as it is: poles that were moved since then do not matter.
        """
        with self._lock:
            project = self.project
            self._refuse_without_scores(is_open=self._live.is_open)
            pose = {key: parse_number(body[key], key) for key in _POSE if body.get(key) not in (None, "")}
            request = {"site": require_text(body, "site"), "pose": pose, "request": body.get("request")}
            opened = {}
            if not self._live.is_open:
                self._refuse_while_running()
                opened = project.copy_with_run(self.workspace.scratch / "live")
            self._live.request(opened, request)
            return {}

    # ---- to take along

    def downloads(self, _body: Body) -> Answer:
        """Return the menu."""
        project = self.project
        is_finished = project.run_state()["state"] in ("complete", "outdated")
        return downloads.describe_downloads(project.run_folder if is_finished else None, project.identifier)

    def make_download(self, _body: Body, identifier: str) -> Answer:
        """Make something to take along: a job, unless it is there."""
        url = f"/api/files/{identifier}"
        if identifier == "scenario":
            return {"url": url}
        download = downloads.find_download(identifier)
        if download is None:
            raise RefusalError(404, f"there is no download {identifier[:40]!r}")
        run = self._finished_run()
        if not download.words:
            return {"url": url}
        if reason := download.reason(downloads.command_names()):
            raise RefusalError(409, f"{download.title}: {reason}.")
        command, *options = download.words
        words = [command, str(run), *(str(run / word) if word == download.made else word for word in options)]
        return self._start_job("export", download.title, {"words": words}, lambda _: {"url": url})

    def file(self, identifier: str) -> Path:
        """Return a file to take along; several are packed."""
        if identifier == "scenario":
            project = self.project
            return self.workspace.pack(project.folder, self.workspace.scratch / f"{project.scenario.name}.zip")
        download, run = downloads.find_download(identifier), self._finished_run()
        made = [] if download is None else download.files(run)
        if download is None or not made:
            raise RefusalError(404, "There is no such file yet.")
        if not (run / download.made).is_dir():
            return made[0]
        target = self.workspace.scratch / f"{self.project.scenario.name}-{identifier}.zip"
        return self.workspace.pack(run / download.made, target)

    def open_three(self, body: Body) -> Answer:
        """Start the explorer of the run for a frame, and let it show a sensor, moved or not; return its address."""
        with self._lock:
            is_open = self._three is not None and self._three[0].poll() is None
            self._refuse_without_scores(is_open=is_open)
            if self._three is None or not is_open:
                self._close_three()
                self._three = _start_explorer(self.project.run_folder)
            address = self._three[1]
        if body.get("site"):
            ranked = {site.site: site for site in Ranking.read(RunFolder(self.project.run_folder).scores).sites}
            name = require_text(body, "site")
            if name not in ranked:
                raise RefusalError(404, f"the run has no candidate {name[:80]!r}", "", "site")
            pose = {key: getattr(ranked[name], key) for key in (*_POSE, "roll_deg")}
            pose |= {key: parse_number(body[key], key) for key in _POSE if body.get(key) not in (None, "")}
            view = urlencode({"site": name, "pose": ",".join(map(str, pose.values()))}, safe=",")
            _open_link(f"{address}&{view}")
        return {"address": address}

    def _close_run(self) -> None:
        """End what has the run open."""
        self._live.close()
        self._close_three()

    def _close_three(self) -> None:
        if self._three is not None:
            process = self._three[0]
            self._three = None
            process.kill()
            process.wait()
            for stream in (process.stdout, process.stderr):
                if stream is not None:
                    stream.close()


def _start_explorer(run: Path) -> tuple[subprocess.Popen[str], str]:
    """Start the explorer of a run; return its process and its address."""
    words = [sys.executable, "-m", "egvs", "explore", str(run), "--no-browser"]
    process = subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stderr is not None
    address = process.stdout.readline().partition("  ")[0].strip()
    if not address.startswith("http://"):
        reason = process.stderr.read()[-2000:].strip().rpartition("\n")[2]
        process.communicate()
        raise RefusalError(422, reason or "the explorer did not start")
    threading.Thread(target=process.stderr.read, daemon=True).start()
    return process, address


def _open_link(link: str) -> None:
    """Open a link to a view, as a browser does that follows no redirection: all pages of the explorer show it."""
    parts = urlsplit(link)
    connection = http.client.HTTPConnection(parts.netloc, timeout=_EXPLORER_S)
    with contextlib.closing(connection):
        connection.request("GET", f"/?{parts.query}")
        connection.getresponse()


_EXPLORER_S = 30.0
_POSE = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg")


# ---- HTTP


async def read_body(request: Request) -> Body:
    """Return the JSON object of a request, which is limited while it arrives."""
    data = bytearray()
    async for chunk in request.stream():
        data += chunk
        if len(data) > MAX_BODY_BYTES:
            raise RefusalError(413, f"the request is larger than {MAX_BODY_BYTES:,} bytes")
    if not data:
        return {}
    try:
        body = json.loads(data)
    except (ValueError, RecursionError):
        raise RefusalError(400, "the request is not JSON") from None
    if not isinstance(body, dict):
        raise RefusalError(400, "the request is no JSON object")
    return body


async def save_upload(request: Request, path: Path) -> None:
    """Write the body of a request to a file, as long as it is not too large."""
    size = 0
    try:
        with path.open("wb") as file:
            async for chunk in request.stream():
                size += len(chunk)
                if size > MAX_UPLOAD_BYTES:
                    raise RefusalError(413, f"the file is larger than {MAX_UPLOAD_BYTES >> 20} MB")
                file.write(chunk)
    except BaseException:
        path.unlink(missing_ok=True)
        path.parent.rmdir()
        raise


_REFUSALS = (RefusalError, EgvsError, OSError)


def _refusal_response(error: Exception, field: str = "") -> Response:
    if isinstance(error, EgvsError):
        error = RefusalError.of(error, field)
    elif isinstance(error, OSError):  # a file was removed, or the disk is full
        error = RefusalError(409, f"{error.filename or 'a file'}: {error.strerror}")
    assert isinstance(error, RefusalError)
    close = {"Connection": "close"} if error.status == 413 else None  # the rest of the body is not read
    return JSONResponse(error.content, error.status, headers=close)


Call = Callable[..., Answer]


def endpoint(call: Call, status: int = 200) -> Callable[[Request], Any]:
    """Return the function that answers requests with a call; parts of the path are its arguments."""

    async def answer(request: Request) -> Response:
        try:
            body = await read_body(request) if request.method != "GET" else {}
            content = await run_in_threadpool(call, body, **request.path_params)
        except _REFUSALS as error:
            return _refusal_response(error)
        is_job = status == 202 and "job" in content
        return JSONResponse(content, 202 if is_job else 200, headers={"Cache-Control": "no-store"})

    return answer


async def upload(
    desk: Desk, request: Request, take: Callable[[str, Path], Answer], suffixes: tuple[str, ...]
) -> Response:
    """Save the body of a request as a file of a known kind, and answer with what a call makes of it."""
    name = request.query_params.get("name", "")
    try:
        path = desk.workspace.begin_upload(name, suffixes)
        await save_upload(request, path)
        return JSONResponse(await run_in_threadpool(take, name, path), 201)
    except _REFUSALS as error:
        return _refusal_response(error, "name")


def send_file(find: Callable[..., Path], *, is_attachment: bool = True) -> Callable[[Request], Any]:
    """Return the function that answers requests with the file that a call finds."""

    async def answer(request: Request) -> Response:
        try:
            path = await run_in_threadpool(find, **request.path_params)
        except _REFUSALS as error:
            return _refusal_response(error)
        kind = "application/octet-stream" if is_attachment else _TYPES[path.suffix]
        filename = path.name if is_attachment else None
        return FileResponse(path, filename=filename, media_type=kind, headers={"Cache-Control": "no-store"})

    return answer


def make_application(desk: Desk) -> Starlette:
    """Return the application, without the guard."""

    async def upload_map(request: Request) -> Response:
        suffixes = (*map_suffixes(), ".zip")
        return await upload(desk, request, lambda name, path: desk.workspace.add_map(name, path).to_json(), suffixes)

    async def import_scenario(request: Request) -> Response:
        def take(name: str, path: Path) -> Answer:
            try:
                return desk.open({"scenario": desk.workspace.import_scenario(name, path)})
            finally:
                shutil.rmtree(path.parent)

        return await upload(desk, request, take, (".zip",))

    async def upload_picture(request: Request) -> Response:
        beside = [request.query_params.get(key, "") for key in ("world", "crs")]

        def take(name: str, path: Path) -> Answer:
            return desk.add_picture(AerialPicture(path, name[:80], *beside), **request.path_params)

        return await upload(desk, request, take, aerial.SUFFIXES)

    async def events(_request: Request) -> Response:
        stream = desk.events.stream(desk.first_event())
        return StreamingResponse(stream, media_type="text/event-stream", headers={"Cache-Control": "no-store"})

    async def static(request: Request) -> Response:
        path = (STATIC / request.path_params.get("name", "index.html")).resolve()
        if not path.is_relative_to(STATIC.resolve()) or path.suffix not in _TYPES or not path.is_file():
            return _refusal_response(RefusalError(404, "there is no such file"))
        return FileResponse(path, media_type=_TYPES[path.suffix], headers={"Cache-Control": "no-cache"})

    @contextlib.asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        looking = asyncio.create_task(_look_at_files(desk))
        yield
        looking.cancel()
        await run_in_threadpool(desk.close)

    get, post = partial(Route, methods=["GET"]), partial(Route, methods=["POST"])
    routes = [
        get("/", static), get("/static/{name:path}", static), get("/api/events", events),
        get("/api/start", endpoint(desk.start)), get("/api/state", endpoint(desk.state)),
        post("/api/open", endpoint(desk.open)), post("/api/copy", endpoint(desk.copy)),
        post("/api/close", endpoint(desk.close_project)), post("/api/maps", upload_map),
        post("/api/aerial", upload_picture), get("/api/aerial", send_file(desk.picture, is_attachment=False)),
        post("/api/maps/{identifier}/aerial", upload_picture),
        get("/api/maps/{identifier}/aerial", send_file(desk.picture, is_attachment=False)),
        Route("/api/aerial", endpoint(desk.remove_picture), methods=["DELETE"]),
        post("/api/import", import_scenario), post("/api/maps/download", endpoint(desk.download_map, 202)),
        Route("/api/signals", endpoint(desk.set_signals), methods=["PUT"]),
        Route("/api/obstacles", endpoint(desk.set_obstacles), methods=["PUT"]),
        post("/api/what_if", endpoint(desk.what_if, 202)), get("/api/what_if", endpoint(desk.show_what_if)),
        get("/api/maps/{identifier}", endpoint(desk.show_map)),
        post("/api/maps/{identifier}/read", endpoint(desk.read_map, 202)), post("/api/new", endpoint(desk.new, 202)),
        get("/api/map", endpoint(desk.show_scene)), get("/api/check", endpoint(desk.check)),
        get("/api/suggestions", endpoint(desk.suggestions)), post("/api/sites", endpoint(desk.add_site)),
        post("/api/sites/check", endpoint(desk.check_site)),
        Route("/api/sites/{name}", endpoint(desk.edit_site), methods=["PATCH"]),
        Route("/api/sites/{name}", endpoint(desk.remove_site), methods=["DELETE"]),
        Route("/api/counts", endpoint(desk.set_counts), methods=["PUT"]),
        Route("/api/settings", endpoint(desk.set_settings), methods=["PUT"]),
        post("/api/undo", endpoint(desk.undo)), post("/api/redo", endpoint(desk.redo)),
        post("/api/run", endpoint(desk.run, 202)), post("/api/stop", endpoint(desk.stop)),
        get("/api/ranking", endpoint(desk.ranking)), get("/api/traffic", endpoint(desk.show_traffic)),
        post("/api/plan", endpoint(desk.plan, 202)),
        get("/api/plan", endpoint(desk.show_plan)), post("/api/score", endpoint(desk.score)),
        post("/api/additions", endpoint(desk.additions, 202)), post("/api/trial", endpoint(desk.trial, 202)),
        get("/api/downloads", endpoint(desk.downloads)),
        post("/api/downloads/{identifier}", endpoint(desk.make_download, 202)),
        get("/api/files/{identifier}", send_file(desk.file)), post("/api/three", endpoint(desk.open_three)),
    ]  # fmt: skip
    return Starlette(routes=routes, lifespan=lifespan)


async def _look_at_files(desk: Desk) -> None:
    while True:
        await asyncio.sleep(_LOOK_EVERY_S)
        await run_in_threadpool(desk.look_at_files)
