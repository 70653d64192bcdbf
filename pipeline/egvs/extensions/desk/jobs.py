"""Jobs in processes of their own (:mod:`egvs.extensions.desk.worker`): one at a time, with progress, and stopped."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from egvs.core.errors import EgvsError
from egvs.extensions.desk.refusals import RefusalError

Publish = Callable[[str, Any], None]
STAGE_SHARES = {
    "check": 0.1, "statics": 0.02, "scan": 0.1, "traffic": 0.2, "tpog": 0.06, "score": 0.48, "report": 0.04
}  # fmt: skip
"""Usual shares of the stages in the time of a run, in the order of execution."""

_LOG_LINES = 200
_LEAST_SHARE = 0.05
"""Before so much is done, the remaining time is not known."""

_END_S = 10.0
"""Time for a stopped job to end by itself."""


def start_worker(request: dict[str, Any]) -> subprocess.Popen[str]:
    """Start a worker; it ends when its standard input is closed, also because this process has ended."""
    process = subprocess.Popen(
        [sys.executable, "-m", "egvs.extensions.desk.worker"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, encoding="utf-8", errors="replace", cwd=request.get("cwd"),
    )  # fmt: skip
    assert process.stdin is not None
    process.stdin.write(json.dumps(request) + "\n")
    process.stdin.flush()
    return process


def _close_pipes(process: subprocess.Popen[str]) -> None:
    for pipe in (process.stdin, process.stdout, process.stderr):
        if pipe is not None:
            with contextlib.suppress(OSError):  # of a line that the ended process did not read
                pipe.close()


def ask_worker(request: dict[str, Any]) -> dict[str, Any]:
    """Return the result of a short job, whose libraries then leave the memory; RefusalError if the job fails."""
    process = start_worker(request)
    assert process.stdout is not None and process.stderr is not None
    messages = [json.loads(line) for line in process.stdout]
    process.wait()
    log = process.stderr.read().splitlines()
    _close_pipes(process)
    end = messages[-1] if messages else {}
    if "result" not in end:
        raise RefusalError(409, _why_failed(end, log, process.returncode), end.get("hint", ""))
    result: dict[str, Any] = end["result"]
    return result


def _why_failed(end: dict[str, Any], log: Sequence[str], code: int) -> str:
    """Return what the last message of a worker, else the last line of its log, says."""
    unexplained = log[-1] if log else f"it ended with code {code}"
    return str(end.get("error", unexplained))


class Job:
    """A job and its state.

    Parameters
    ----------
    number, kind, title
        Its number, the key of what it calls, and its name.
    request
        What the worker gets.
    publish
        Called with each event.
    finish
        Called with the result in the end if it is done; returns the result for the page.
    fail
        Called with the reason if it is not done.
    """

    def __init__(
        self, number: int, kind: str, title: str, request: dict[str, Any], publish: Publish,
        finish: Callable[[dict[str, Any]], dict[str, Any]], fail: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._publish, self._finish, self._fail = publish, finish, fail
        self._names: dict[str, str] = request.get("names", {})
        self._log: deque[str] = deque(maxlen=_LOG_LINES)
        self._begin_s = time.monotonic()
        self._is_stopped = False
        self._values: dict[str, Any] = {
            "id": number, "kind": kind, "title": title, "state": "runs", "stage": "", "what": "", "done": 0,
            "total": 0, "share": None, "elapsed_s": 0.0, "remaining_s": None, "message": "", "hint": "", "result": None,
        }  # fmt: skip
        self._process = start_worker({**request, "kind": kind})
        self._threads = [threading.Thread(target=target, daemon=True) for target in (self._read_log, self._read)]
        for thread in self._threads:
            thread.start()

    @property
    def is_running(self) -> bool:
        """Whether it is at work."""
        return bool(self._values["state"] == "runs")

    def to_json(self, *, with_log: bool = False) -> dict[str, Any]:
        """Return its state; with the last lines of its log."""
        values = dict(self._values)
        if values["state"] == "runs":
            values["elapsed_s"] = round(time.monotonic() - self._begin_s, 1)
        return {**values, "log": list(self._log)} if with_log else values

    def stop(self) -> None:
        """Interrupt it, and wait until it has ended."""
        self._is_stopped = True
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        self._threads[1].join(_END_S)
        if self._process.poll() is None:
            self._process.kill()
            self._threads[1].join(_END_S)

    def _read_log(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self._log.append(line.rstrip("\n")[:1000])
            self._publish("log", {"line": self._log[-1]})

    def _read(self) -> None:
        assert self._process.stdout is not None
        end: dict[str, Any] = {}
        for line in self._process.stdout:
            message = json.loads(line)
            if "progress" not in message:
                end = message
                continue
            self._note_progress(*message["progress"])
            self._publish("job", self.to_json())
        self._process.wait()
        self._threads[0].join(_END_S)
        _close_pipes(self._process)
        final: dict[str, Any] = {"elapsed_s": round(time.monotonic() - self._begin_s, 1), "remaining_s": None}
        if "result" in end:
            try:
                final |= {"state": "done", "share": 1.0, "result": self._finish(end["result"])}
            except (RefusalError, EgvsError) as error:
                refusal = error if isinstance(error, RefusalError) else RefusalError.of(error)
                final |= {"state": "failed", "message": refusal.content["message"], "hint": refusal.content["hint"]}
        elif self._is_stopped:
            final |= {"state": "stopped", "message": "Stopped. What finished stages made is kept."}
        else:
            message = _why_failed(end, self._log, self._process.returncode)
            for path, name in self._names.items():
                message = message.replace(path, name)
            final |= {"state": "failed", "message": message, "hint": end.get("hint", "")}
        if final["state"] != "done":
            self._fail(final["message"])
        self._values |= final
        self._publish("job", self.to_json())

    def _note_progress(self, stage: str, what: str, done: int, total: int) -> None:
        now_s = time.monotonic()
        share = run_share(stage, done, total) if self._values["kind"] == "run" else done / total if total else None
        remaining_s = None
        if share is not None and share > _LEAST_SHARE:
            remaining_s = round((now_s - self._begin_s) * (1.0 - share) / share, 1)
        values = {"stage": stage, "what": what, "done": done, "total": total, "remaining_s": remaining_s}
        self._values |= {**values, "share": share}


def run_share(stage: str, done: int, total: int) -> float | None:
    """Return the share of a run that is done, by the usual times of its stages; None before the first one.

    >>> run_share("scan", 1, 2), run_share("", 0, 0)
    (0.17, None)
    """
    if stage not in STAGE_SHARES:
        return None
    names = list(STAGE_SHARES)
    before = sum(STAGE_SHARES[name] for name in names[: names.index(stage)])
    return round(before + (STAGE_SHARES[stage] * min(done / total, 1.0) if total else 0.0), 3)


class LiveScores:
    """Scores of moved sensors, by a worker that keeps the run open: the latest request wins.

    Parameters
    ----------
    publish
        Called with each answer.
    """

    def __init__(self, publish: Publish) -> None:
        self._publish = publish
        self._changed = threading.Condition()
        self._request: dict[str, Any] | None = None
        self._process: subprocess.Popen[str] | None = None
        self._threads: list[threading.Thread] = []

    @property
    def is_open(self) -> bool:
        """Whether a worker has the run open, or opens it."""
        return self._process is not None and self._process.poll() is None

    def request(self, run: dict[str, str], request: dict[str, Any]) -> None:
        """Ask for a score of a run, which is opened unless one is; an earlier request that has not begun is dropped."""
        with self._changed:
            self._request = request
            if not self.is_open:
                self._process = start_worker({**run, "kind": "live"})
                targets = (self._serve, self._drain)
                self._threads = [
                    threading.Thread(target=target, args=(self._process,), daemon=True) for target in targets
                ]
                for thread in self._threads:
                    thread.start()
            self._changed.notify_all()

    def close(self) -> None:
        """End the worker: the run is another one now."""
        with self._changed:
            process, self._process, self._request = self._process, None, None
            self._changed.notify_all()
        if process is not None:
            process.kill()
            process.wait()
            for thread in self._threads:
                thread.join(_END_S)
            _close_pipes(process)

    def _serve(self, process: subprocess.Popen[str]) -> None:
        assert process.stdin is not None and process.stdout is not None
        for line in process.stdout:
            message = json.loads(line)
            if "error" in message:
                with self._changed:
                    number, self._request = (self._request or {}).get("request"), None
                self._publish("score", {"request": number, "ok": False, "message": message["error"]})
                return
            if "score" in message:
                self._publish("score", message["score"])
            with self._changed:
                self._changed.wait_for(lambda: self._request is not None or self._process is not process)
                request, self._request = self._request, None
                if self._process is not process:
                    return
            try:
                process.stdin.write(json.dumps(request) + "\n")
                process.stdin.flush()
            except OSError:  # it was ended meanwhile
                return

    def _drain(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        for line in process.stderr:
            self._publish("log", {"line": line.rstrip("\n")[:1000]})
