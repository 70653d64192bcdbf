"""The program of a job: calls what the command line calls, in a process of its own that can be stopped.

``python -m egvs.extensions.desk.worker`` reads one line with a request in JSON from standard input, and writes lines
in JSON to standard output: ``progress`` (stage, what, done, total), and at the end ``result``, or ``error`` and
``hint``. What commands print goes to standard error. It ends when its standard input is closed.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egvs.core.errors import EgvsError, InputError
from egvs.extensions.desk.refusals import describe_error

if TYPE_CHECKING:
    from egvs.results.plans import SensorPlan
    from egvs.scenario.model import Scenario
    from egvs.stages.base import StageContext

_INTERVAL_S = 0.15
Send = Callable[[dict[str, Any]], None]


class Progress:
    """Sends how far a job is, a few times a second."""

    def __init__(self, send: Send) -> None:
        self.stage = ""
        self._send, self._last = send, ("", "", 0.0)

    def report(self, what: str, done: int, total: int) -> None:
        """Send progress; a :data:`egvs.core.progress.ProgressCallback`."""
        now_s = time.monotonic()
        stage, last_what, last_s = self._last
        if (stage, last_what) == (self.stage, what) and now_s - last_s < _INTERVAL_S:
            return
        self._last = self.stage, what, now_s
        self._send({"progress": [self.stage, what, done, total]})

    def stage_event(self, stage: str, state: str, _record: object) -> None:
        """Note which stage runs; a :data:`egvs.runs.run.StageListener`."""
        if state == "runs":
            self.stage = stage
            self.report("", 0, 0)


def list_junctions(progress: Progress, request: dict[str, Any]) -> dict[str, Any]:
    """Read the streets of a map, and write them for the page to the file ``out``."""
    from egvs.core import files
    from egvs.creation.new_scenario import read_map_roads
    from egvs.extensions.desk.map_view import describe_streets

    roads = read_map_roads([request["map"]], progress=progress.report)
    files.write_text(Path(request["out"]), json.dumps(describe_streets(roads.streets, roads.attribution)))
    return {}


def download_map(progress: Progress, request: dict[str, Any]) -> dict[str, Any]:
    """Download the map around a point, as ``egvs new --download``, and copy it to the file ``out``."""
    from egvs.creation.openstreetmap import overpass

    progress.report("downloads the map", 0, 0)
    extract = overpass.download_extract((request["at"][0], request["at"][1]))
    shutil.copyfile(extract.path, request["out"])
    return {"note": extract.note}


def create(progress: Progress, request: dict[str, Any]) -> dict[str, Any]:
    """Make a scenario, as ``egvs new``; where the map has no poles at the junction, with new ones at the kerbs."""
    from dataclasses import replace

    from egvs.creation.new_scenario import NewScenarioOptions, create_scenario

    progress.report("makes the scenario", 0, 0)
    at = None if request["at"] is None else (request["at"][0], request["at"][1])
    options = NewScenarioOptions(
        existing_poles=request["poles"] == "existing", traffic=request["traffic"], walk=request["walk"]
    )
    try:
        made = create_scenario(request["folder"], request["map"], at, options)
    except InputError as error:
        if error.where != "--poles existing":
            raise
        made = create_scenario(request["folder"], request["map"], at, replace(options, existing_poles=False))
        note = f"The candidates are new poles at the kerbs: {error.problem}."
        return {"notes": [note, *made.notes], "note": note}
    return {"notes": list(made.notes)}


def run_stages(progress: Progress, request: dict[str, Any]) -> dict[str, Any]:
    """Run a scenario, and print the answer, as ``egvs run``."""
    from egvs.cli import answer
    from egvs.cli.console import ProgressDisplay
    from egvs.runs.run import run
    from egvs.scenario.loading import load

    folder = Path(request["run"])
    with ProgressDisplay("run", is_run=True) as screen:

        def listen(stage: str, state: str, record: Any) -> None:
            progress.stage_event(stage, state, record)
            screen.stage_event(stage, state, record)

        scenario = load(request["scenario"])
        screen.flow_source = answer.flow_source(scenario)
        record = run(scenario, folder, progress=progress.report, listener=listen)
    answer.print_answer(folder, scenario, record, lines_before=screen.warning_lines)
    return {}


def plan(progress: Progress, request: dict[str, Any]) -> dict[str, Any]:
    """Plan several sensors, as ``egvs place``, and bring the ranking up to date; then as :func:`describe_additions`."""
    from egvs.extensions.desk import results_view
    from egvs.placement.plan import place
    from egvs.runs.run_sources import SettingsSource
    from egvs.scenario.loading import load

    scenario = SettingsSource.of(Path(request["scenario"])).load_with_request(request["request"])
    place(scenario, request["run"], progress=progress.report, listener=progress.stage_event)
    if results_view.describe_run(Path(request["run"]), load(request["scenario"]))["state"] != "complete":
        run_stages(progress, request)
    return describe_additions(progress, request)


def describe_additions(progress: Progress, request: dict[str, Any]) -> dict[str, Any]:
    """Say what each sensor of the plan adds."""
    from egvs.extensions.desk import plan_sensors

    progress.report("compares the sensors", 0, 0)
    with _open_plan(request) as (context, planned):
        return {"adds": plan_sensors.describe_additions(context, planned)}


def try_sensor(progress: Progress, request: dict[str, Any]) -> dict[str, Any]:
    """Score the plan with the sensors of another table of sites."""
    from egvs.extensions.desk import plan_sensors
    from egvs.scenario.loading import load

    progress.report("scans and scores", 0, 0)
    with _open_plan(request) as (context, planned):
        changed = _open_run(load(request["scenario"], request["settings"]), Path(request["run"]))
        tried = plan_sensors.try_sensors(context, planned, changed)
    by = planned.by
    sign = "+" if tried.joint > planned.joint else ""
    change = by.change(tried.joint - planned.joint, tried.change_se)
    return {
        "label": by.noun, "before_text": by.with_unit(planned.joint, planned.joint_se),
        "after_text": by.with_unit(tried.joint, tried.joint_se),
        "change_text": f"{sign}{change} {by.change_unit}".rstrip(),
    }  # fmt: skip


@contextmanager
def _open_plan(request: dict[str, Any]) -> Iterator[tuple[StageContext, SensorPlan]]:
    """Open the run of a scenario, and its plan."""
    from egvs.artefacts.run_folder import RunFolder
    from egvs.core.digests import use_digests
    from egvs.results.plans import SensorPlan
    from egvs.runs.run import lock_run_folder
    from egvs.scenario.loading import load

    folder = Path(request["run"])
    with lock_run_folder(folder):
        planned = SensorPlan.read(RunFolder(folder))
        assert planned is not None, "the plan was removed"
        context = _open_run(load(request["scenario"]), folder)
        with use_digests(context.inputs.digests):
            yield context, planned


def _open_run(scenario: Scenario, folder: Path) -> StageContext:
    """Open the run of a scenario, whose sensors may be others since."""
    from egvs.artefacts.run_record import RunRecord
    from egvs.runs import stage_registry
    from egvs.runs.run_context import open_folder

    recorded = stage_registry.recorded_digests(RunRecord.read(folder))
    return open_folder(scenario, folder, recorded=recorded)


def evaluate_obstacles(progress: Progress, request: dict[str, Any]) -> dict[str, Any]:
    """Compare the ranking with that with obstacles, as ``egvs what-if``."""
    from dataclasses import replace

    from egvs.artefacts.run_folder import RunFolder
    from egvs.cli.what_if import describe_plan
    from egvs.results.ranking import Ranking, site_titles
    from egvs.results.sensors import difference_unit, format_difference
    from egvs.studies.what_if import what_if

    result = what_if(
        request["scenario"], names=[request["table"]], progress=progress.report, listener=progress.stage_event
    )
    (answer,) = result.answers
    titles = site_titles(Ranking.read(RunFolder(result.runs[0].folder).scores).sites)
    rows = []
    for site in result.sites:
        after = site.present[0]
        row = {
            "site": titles[site.site],
            "before_text": result.label.with_unit(site.before),
            "after_text": "impossible",
        }
        row["change_text"] = ""
        if after is not None:
            row["after_text"] = result.label.with_unit(after)
            row["change_text"] = f"{result.label.change(after - site.before)} {result.label.change_unit}"
        if site.site == result.best.site and answer.change is not None:
            row["change_text"] = f"{format_difference(answer.change, result.best)} {difference_unit(result.best)}"
        rows.append(row)
    answer = replace(
        answer, best_before=titles[answer.best_before], best_expected=titles[answer.best_expected],
        rival=titles.get(answer.rival, ""),
    )  # fmt: skip
    return {"text": [*describe_plan(result), answer.conclusion(), *result.notes], "sites": rows}


def describe_traffic(_progress: Progress, request: dict[str, Any]) -> dict[str, Any]:
    """Describe the recorded traffic of a run for the map."""
    from egvs.extensions.desk import results_view

    return results_view.describe_traffic(Path(request["run"]))


def run_command(progress: Progress, request: dict[str, Any]) -> dict[str, Any]:
    """Run a command of the command line."""
    from egvs.cli.app import app

    progress.report("writes", 0, 0)
    app(args=request["words"], standalone_mode=False)
    return {}


def rate_poses(send: Send, request: dict[str, Any]) -> dict[str, Any]:
    """Score one pose after another, as the explorer: each line of standard input is a request."""
    from dataclasses import replace

    from egvs.explore.session import Session
    from egvs.explore.settings import open_session
    from egvs.results.labels import SCORE_LABELS

    session: Session = open_session(request["scenario"], out=request["run"])
    label = SCORE_LABELS[session.rank_by]
    send({"ready": True})
    for line in sys.stdin:
        wanted = json.loads(line)
        answer: dict[str, Any] = {"request": wanted.get("request"), "site": wanted["site"], "ok": False, "message": ""}
        try:
            candidate = session.candidates[wanted["site"]].site
            rated = session.rate(candidate.name, replace(candidate.pose, **wanted["pose"]))
            if rated.is_feasible:
                score = rated.scores[session.rank_by]
                answer |= {"ok": True, "score": score, "score_text": label.with_unit(score), "rank": rated.rank}
            else:
                answer["message"] = "; ".join(finding.problem for finding in rated.findings if finding.is_error)
        except KeyError:
            answer["message"] = f"the run has no candidate {wanted['site']}"
        except EgvsError as error:
            answer["message"] = describe_error(error)[0]
        send({"score": answer})
    return {}


JOBS: dict[str, Callable[[Progress, dict[str, Any]], dict[str, Any]]] = {
    "junctions": list_junctions, "download": download_map, "new": create, "run": run_stages, "plan": plan,
    "additions": describe_additions, "trial": try_sensor, "what_if": evaluate_obstacles, "export": run_command,
    "traffic": describe_traffic,
}  # fmt: skip
"""What each kind of job calls."""


def _end_with_input() -> None:
    """Interrupt this program when its standard input is closed."""
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGINT)


def main() -> int:
    """Do one job; return the exit code."""
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]

    def send(message: dict[str, Any]) -> None:
        channel.write(json.dumps(message) + "\n")

    try:
        request = json.loads(sys.stdin.readline())
        if request["kind"] == "live":
            result = rate_poses(send, request)
        else:
            threading.Thread(target=_end_with_input, daemon=True).start()
            result = JOBS[request["kind"]](Progress(send), request)
    except EgvsError as error:
        message, hint = describe_error(error)
        send({"error": message, "hint": hint})
        return error.exit_code
    except (OSError, MemoryError) as error:
        send({"error": str(error) or "not enough memory", "hint": ""})
        return EgvsError.exit_code
    except KeyboardInterrupt:
        return 130
    send({"result": result})
    return 0


if __name__ == "__main__":
    sys.exit(main())
