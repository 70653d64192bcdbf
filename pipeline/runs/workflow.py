"""How does a scenario become a ranking?

:func:`run` is the whole program: static world and empty scans, traffic and the TPOG, scores, the report. A stage whose
inputs (settings by value, files by hash) are those of the last run, and whose artefacts are still what it wrote, is
skipped. After each stage ``run.json`` is written anew, so that an interrupted run goes on from the last whole stage.

:func:`verify` runs again what ``run.json`` says and compares every artefact byte for byte.
"""

from __future__ import annotations

import importlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from pipeline.core import files
from pipeline.core.version import __version__
from pipeline.artefacts import tables
from pipeline.core.cost import measured
from pipeline.core.errors import InputError, RunError
from pipeline.scenario.loading import from_values
from pipeline.scenario.models import Scenario
from pipeline.core.progress import Progress, silent

STAGES = ("statics", "scan", "traffic", "tpog", "score", "report")
"""In the order of running. The two branches do not know each other; the quick one comes first, so that a site in a wall
is told before traffic is simulated."""

RECORD = "run.json"

Told = Callable[[str, str, dict[str, Any]], None]
"""Called with (stage, "runs" | "done" | "skipped", its record) as a run goes on."""


def _mute(_stage: str, _state: str, _record: dict[str, Any]) -> None:
    """A :data:`Told` that says nothing."""


def run(
    scenario: Scenario,
    out: str | Path | None = None,
    *,
    jobs: int | None = None,
    progress: Progress = silent,
    told: Told = _mute,
    options: dict[str, dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Run every stage whose inputs changed, in order.

    Parameters
    ----------
    scenario
        From :func:`pipeline.load`.
    out
        The run's folder; ``runs/<scenario name>`` when None.
    jobs
        Threads; one a core when None. Results do not depend on it.
    options
        Further keyword arguments of single stages, e.g. ``{"score": {"audit": True}}``; such a stage is not skipped.

    Returns
    -------
    dict
        What ``run.json`` holds.
    """
    folder = Path(out) if out is not None else default_folder(scenario)
    with alone(folder):
        record = _read_record(folder, scenario)
        for name in STAGES:
            run_stage(name, scenario, folder, record, jobs=jobs, progress=progress, told=told, **(options or {}).get(name, {}))
        return record


def run_one(
    name: str,
    scenario: Scenario,
    out: Path,
    *,
    jobs: int | None = None,
    progress: Progress = silent,
    told: Told = _mute,
    **options: Any,
) -> dict[str, Any]:
    """Run a single stage, whether its inputs changed or not, and note it in ``run.json``."""
    with alone(out):
        record = _read_record(out, scenario)
        record["stages"].pop(name, None)
        run_stage(name, scenario, out, record, jobs=jobs, progress=progress, told=told, **options)
        for other in [stage for stage in record["stages"] if stage != name and not _is_of(stage, scenario, out, record)]:
            del record["stages"][other]  # of other settings: the record would contradict itself
        _write_record(out, record)
        return record


def refresh_report(out: Path) -> Path | None:
    """Draw the report of a whole run anew where something that it shows has changed, an accuracy study say; the
    report's path.

    None, and nothing is done, where there is no whole run. For those who hold the folder (:func:`alone`).
    """
    if not (out / RECORD).is_file():
        return None
    record = _load_record(out)
    source = Path(os.path.normpath(out / record["scenario_folder"]))
    if not all(name in record["stages"] for name in STAGES) or not source.is_dir():
        return None
    scenario = from_values(record["scenario"], source, str(out / RECORD))
    if not all(_is_of(name, scenario, out, record) for name in STAGES if name != "report"):
        return None
    run_stage("report", scenario, out, record, jobs=None, progress=silent, told=_mute)
    return out / "report.html"


def _is_of(name: str, scenario: Scenario, out: Path, record: dict[str, Any]) -> bool:
    """Whether a stage's last run is what this scenario, and the artefacts as they are now, would give."""
    try:
        return bool(record["stages"][name]["inputs"] == key(name, scenario, out))
    except InputError:
        return False


def key(name: str, scenario: Scenario, out: Path) -> str:
    """A hash of everything that a stage's artefacts depend on; ``out`` holds those of the stages before."""
    return files.hash_of({"egvs": __version__, **_stage(name).inputs(scenario, out)})


def default_folder(scenario: Scenario) -> Path:
    """Where a run goes when no folder is given."""
    return Path("runs") / scenario.name


def run_stage(
    name: str,
    scenario: Scenario,
    out: Path,
    record: dict[str, Any],
    *,
    jobs: int | None,
    progress: Progress,
    told: Told,
    **options: Any,
) -> None:
    """Run one stage unless nothing changed; ``record`` (the content of ``run.json``) is brought up to date and
    written."""
    stage = _stage(name)
    inputs = key(name, scenario, out)
    last = record["stages"].get(name)
    if last and not options and last["inputs"] == inputs and _intact(out, last["artefacts"]):
        told(name, "skipped", last)
        return
    told(name, "runs", {})
    record["stages"].pop(name, None)
    _write_record(out, record)
    with measured() as cost:
        said = stage.run(scenario, out, jobs=jobs, progress=progress, **options)
    done = {
        "inputs": inputs,
        "artefacts": {a: files.sha256_of(out / a) for a in stage.ARTEFACTS if (out / a).exists()},
        "summary": said,
        "cost": cost.to_json(),
    }
    record["stages"][name] = done
    record["scenario"] = scenario.model_dump(mode="json")
    _write_record(out, record)
    told(name, "done", done)


def verify(
    folder: Path, scenario_folder: Path | None = None, *, jobs: int | None = None, progress: Progress = silent, told: Told = _mute
) -> list[str]:
    """Run again what ``folder/run.json`` says, elsewhere, and compare.

    Parameters
    ----------
    scenario_folder
        Where the scenario's files are; where ``run.json`` says when None.

    Returns
    -------
    list of str
        One line for each artefact that differs: altered since the run, or not reproduced by it. Empty when all is well.
    """
    record = _load_record(folder)
    missing = [name for name in STAGES if name not in record["stages"]]
    if missing:
        raise InputError(folder / RECORD, f"the stage {missing[0]} is not done", "a finished run; call egvs run first")
    source = scenario_folder or Path(os.path.normpath(folder / record["scenario_folder"]))
    if not source.is_dir():
        raise InputError(folder / RECORD, f"the scenario's folder {source} is not there", "name it with --scenario")
    scenario = from_values(record["scenario"], source, str(folder / RECORD))
    wrong = [f"{name} was altered after the run" for name in _altered(folder, record)]
    with tempfile.TemporaryDirectory(prefix="egvs-verify-") as temporary:
        again = _new_record(scenario, Path(temporary))
        for name in STAGES:
            if name == "report":
                # It shows what the stages cost, which is part of the record, and an accuracy study if one was made.
                again["stages"] |= {n: {**again["stages"][n], "cost": record["stages"][n]["cost"]} for n in again["stages"]}
                _write_record(Path(temporary), again)
                if not _is_of(name, scenario, Path(temporary), record):
                    for study in folder.glob("accuracy.p*"):
                        shutil.copy(study, temporary)
                    if not _is_of(name, scenario, Path(temporary), record):
                        wrong.append("report.html shows an accuracy study that was replaced since; egvs report draws it anew")
            run_stage(name, scenario, Path(temporary), again, jobs=jobs, progress=progress, told=told)
            wrong += _differences(name, record, again)
    return wrong


def _differences(name: str, record: dict[str, Any], again: dict[str, Any]) -> Iterator[str]:
    before, after = record["stages"][name]["artefacts"], again["stages"][name]["artefacts"]
    for artefact in sorted(before.keys() | after.keys()):
        then, now = (digests.get(artefact, "absent")[:12] for digests in (before, after))
        if then != now:
            yield f"{artefact} differs from what the run made: {then} then, {now} now"


def _altered(folder: Path, record: dict[str, Any]) -> Iterator[str]:
    for stage in record["stages"].values():
        for artefact, digest in stage["artefacts"].items():
            path = folder / artefact
            if not path.is_file() or files.sha256_of(path) != digest:
                yield artefact


def _stage(name: str) -> ModuleType:
    """A stage's module, imported when it is needed (``--help`` and a skipped run stay quick)."""
    return importlib.import_module("pipeline.report.page" if name == "report" else f"pipeline.stages.{name}")


def _intact(out: Path, artefacts: dict[str, str]) -> bool:
    return all((out / name).is_file() and files.sha256_of(out / name) == digest for name, digest in artefacts.items())


def _new_record(scenario: Scenario, folder: Path) -> dict[str, Any]:
    return {
        "egvs": __version__,
        "seed": scenario.seed,
        "scenario": scenario.model_dump(mode="json"),
        "scenario_folder": Path(os.path.relpath(scenario.folder, folder)).as_posix(),
        "effects": [],
        "stages": {},
    }


def _read_record(folder: Path, scenario: Scenario) -> dict[str, Any]:
    """What is known of earlier work in this folder, with the scenario as it is now."""
    record = _new_record(scenario, folder)
    if (folder / RECORD).is_file():
        record["stages"] = _load_record(folder)["stages"]
    return record


def _load_record(folder: Path) -> dict[str, Any]:
    path = folder / RECORD
    try:
        record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        record["stages"].items()
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(path, "no such file", "a folder that egvs run has written") from None
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(path, f"is not a run's record ({error})", "remove it and run again") from None
    for key, kind in (("egvs", str), ("seed", int), ("scenario", dict), ("scenario_folder", str), ("effects", list)):
        if not isinstance(record.get(key), kind):
            raise InputError(path, f"is not a run's record ({key!r} is {record.get(key)!r})", "remove it and run again")
    return record


def _write_record(out: Path, record: dict[str, Any]) -> None:
    files.write_text(out / RECORD, json.dumps(record, indent=2, ensure_ascii=False) + "\n")


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Keep two runs out of one folder; the lock goes with the process, however it ends."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / ".lock").open("w")
    except OSError as error:
        raise InputError(folder, f"cannot be written ({error.strerror})", "a folder of yours") from None
    with lock:
        try:
            import fcntl

            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunError(f"{folder}: another run is at work there") from None
        yield


__all__ = ["RECORD", "STAGES", "alone", "default_folder", "key", "refresh_report", "run", "run_one", "run_stage", "verify"]
