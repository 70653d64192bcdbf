"""The open scenario: its files, what the page may change in them, and undo and redo.

All state is in the files, which can also be edited by hand. A step of undo is the contents of the files before and
after it. A change is checked as ``egvs check`` reads the files; if it is refused, nothing has changed.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import re
import shutil
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import tomlkit

from egvs.artefacts.run_folder import RUNS, RunFolder
from egvs.core import files, limits
from egvs.core.errors import EgvsError, InputError
from egvs.core.numbers import number_or_nan
from egvs.extensions.desk import aerial, map_view, obstacles, results_view, traffic_view
from egvs.extensions.desk.pole_check import PoleCheck, kerb_positions
from egvs.extensions.desk.refusals import RefusalError, parse_number, require_text
from egvs.scenario.loading import load
from egvs.scenario.model import SCENARIO_FILE, Scenario
from egvs.sensors import site_files, sites
from egvs.sensors.sensor import CATALOGUE
from egvs.stages.inputs import Inputs
from egvs.traffic.network import Network
from egvs.world import geolocation

Contents = dict[str, str]
"""Text of each file of a scenario that the page may change, by name."""

_EDITED = re.compile(r"[^/\\]+\.csv", re.IGNORECASE)
_POSITION_COLUMNS = ("site", "x_m", "y_m")
_OPTIONAL_NUMBERS = {"z_m": (-500.0, 10_000.0), "yaw_deg": (-360.0, 360.0), "pitch_deg": (-90.0, 90.0),
                     "cost": (0.0, 1e9)}  # fmt: skip
_SETTINGS = {
    "frames": ("traffic", "frames"), "warmup_s": ("traffic", "warmup_s"), "seed": ("seed",),
    "sensor": ("sites", "sensor"), "heights_m": ("sites", "heights_m"), "pitch_deg": ("sites", "pitch_deg"),
    "pole_cost": ("costs", "pole"), "sensor_costs": ("costs", "sensor"),
}  # fmt: skip
_WHOLE = ("frames", "seed")
KEEP_RESULTS = "keep_results"
"""Key of a change that says whether the results of the run have to stay current (:meth:`Project.protect_results`)."""
_UNCOUNTED = "traffic that was not counted"
"""What ``assumed`` says after counts were typed."""

_OF_MAP_NAME = re.compile(r"(lamp|signal|pole)\d+")


@dataclass(frozen=True)
class Step:
    """A change: its name, and the contents of the files that it changed, before and after it."""

    label: str
    before: Contents
    after: Contents


@dataclass
class CsvTable:
    """A table in a CSV file, with its columns and rows in their order."""

    columns: list[str]
    rows: list[dict[str, str]]
    delimiter: str = ","

    @classmethod
    def parse(cls, text: str) -> CsvTable:
        """Return the table of a text."""
        head = text.partition("\n")[0]
        delimiter = ";" if head.count(";") > head.count(",") else ","
        rows = [row for row in csv.reader(io.StringIO(text.removeprefix("\ufeff")), delimiter=delimiter) if any(row)]
        columns = [name.strip() for name in rows[0]] if rows else []
        return cls(columns, [dict(zip(columns, row, strict=False)) for row in rows[1:]], delimiter)

    def to_text(self) -> str:
        """Return the text; columns for the sensor that are empty everywhere are left out."""
        optional = (*_OPTIONAL_NUMBERS, "sensor")
        columns = [name for name in self.columns if name not in optional or any(row.get(name) for row in self.rows)]
        text = io.StringIO()
        writer = csv.writer(text, delimiter=self.delimiter, lineterminator="\n")
        writer.writerows([columns, *([row.get(name, "") for name in columns] for row in self.rows)])
        return text.getvalue()

    def set(self, row: dict[str, str], column: str, value: str) -> None:
        """Set a value, in a new column if need be."""
        if column not in self.columns and value:
            self.columns.append(column)
        row[column] = value


@dataclass
class _Scene:
    """What is made of one version of the scenario's settings and map: slow to make, and kept while they stay."""

    key: str
    inputs: Inputs

    @cached_property
    def poles(self) -> PoleCheck:
        return PoleCheck(self.inputs)

    @cached_property
    def view(self) -> dict[str, Any]:
        return map_view.describe_scene(self.inputs)

    @cached_property
    def suggestions(self) -> list[dict[str, Any]]:
        return kerb_positions(self.inputs)


@dataclass
class Project:
    """A scenario in a folder.

    Attributes
    ----------
    identifier
        Its name in the workspace.
    folder, run_folder
        Folders of the scenario and of its run.
    notes
        What ``egvs new`` said about it.
    """

    identifier: str
    folder: Path
    run_folder: Path
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.lock = threading.RLock()
        self._scene_lock = threading.Lock()  # taken after the other one, if both are
        self._undo: list[Step] = []
        self._redo: list[Step] = []
        self._scenario = load(self.folder)
        self._candidates: tuple[Scenario | None, tuple[sites.Site, ...]] = (None, ())
        self._problem = ""
        self._contents = self._read()
        if SCENARIO_FILE not in self._contents:
            raise RefusalError(409, f"{SCENARIO_FILE} is a link to another folder", "Open that folder.", "scenario")
        self._kept_scene: _Scene | None = None
        self._run_state: tuple[object, dict[str, Any]] = (None, {})
        self._protects, self._given_up = False, 0

    # ---- files

    def _read(self) -> Contents:
        """Return the present texts of the files."""
        names = [SCENARIO_FILE, *self._table_names(), "signals.csv"]
        contents = {}
        for name in dict.fromkeys(names):
            path = self.folder / name
            if path.is_file() and path.resolve().parent == self.folder.resolve():
                contents[name] = limits.read_bytes(path, limits.DOCUMENT).decode("utf-8", "replace")
        return contents

    def _table_names(self) -> list[str]:
        named = [self._scenario.sites.file or "", *self._counts_files().values()]
        return [name for name in named if _EDITED.fullmatch(name)]

    def _counts_files(self) -> dict[str, str]:
        """Return the file of counts by period, empty where they are no file; other traffic has an empty name."""
        traffic = tomlkit.parse((self.folder / SCENARIO_FILE).read_text(encoding="utf-8")).unwrap().get("traffic", {})
        tables = [traffic] if isinstance(traffic, dict) else []
        tables += [table for table in tables[:1] for table in table.get("periods", ()) if isinstance(table, dict)]
        named = {str(table.get("name", "")): table["counts"] for table in tables if table.get("counts")}
        return {period: name if isinstance(name, str) else "" for period, name in named.items()}

    def _counts_file(self, period: str) -> str:
        files = self._counts_files()
        return files.get(period, files.get("", ""))

    def refresh(self) -> bool:
        """Take over what was edited by hand; return whether anything has changed."""
        with self.lock:
            try:
                present = self._read()
                if present == self._contents:
                    return False
                self._note_step("changes on disk", present)
                self._scenario, self._problem = self._load(), ""
            except (EgvsError, OSError, ValueError) as error:
                changed, self._problem = str(error) != self._problem, str(error)
                return changed
            return True

    def _note_step(self, label: str, after: Contents) -> None:
        names = {name for name in {*self._contents, *after} if self._contents.get(name) != after.get(name)}
        before = {name: self._contents.get(name, "") for name in names}
        self._undo.append(Step(label, before, {name: after.get(name, "") for name in names}))
        self._redo.clear()
        self._contents = after

    def _load(self) -> Scenario:
        scenario = load(self.folder)
        self._candidates = scenario, sites.candidate_sites(scenario)
        return scenario

    def protect_results(self, keep: object) -> None:
        """Say whether the next change may make the results of the run out of date.

        True refuses it if it would be the first one that does. False agrees to that, until there are other results.
        """
        scores = RunFolder(self.run_folder).scores
        results = scores.stat().st_mtime_ns if scores.is_file() else 0
        if keep is False:
            self._given_up = results
        self._protects = keep is True and self._given_up != results and self.run_state()["state"] == "complete"

    def _check_results_stay(self, scenario: Scenario) -> None:
        if self._protects and results_view.describe_run(self.run_folder, scenario)["state"] != "complete":
            problem = "The results are about the present poles and counts."
            hint = "After this change they are out of date until the next run."
            raise RefusalError(409, problem, hint, KEEP_RESULTS)

    def _write(self, contents: Contents) -> None:
        for name, text in contents.items():
            files.write_text(self.folder / name, text)

    def _change(self, label: str, after: Contents, field_name: str = "") -> None:
        """Write files, and check that the scenario can be read; else write the former ones, and refuse."""
        changed = {name: text for name, text in after.items() if self._contents.get(name) != text}
        if not changed:
            return
        before = {name: self._contents[name] for name in changed}
        try:
            self._write(changed)
            scenario = self._load()
            self._check_results_stay(scenario)
        except RefusalError:
            self._write(before)
            raise
        except EgvsError as error:
            self._write(before)
            refusal = RefusalError.of(error, field_name)
            refusal.content["message"] = refusal.content["message"].replace(f"{self.folder}/", "")
            raise refusal from None
        self._scenario, self._problem = scenario, ""
        self._note_step(label, {**self._contents, **changed})

    def step_back(self) -> None:
        """Undo the last change."""
        self._move(self._undo, self._redo, is_undo=True)

    def step_forward(self) -> None:
        """Do again what was undone last."""
        self._move(self._redo, self._undo, is_undo=False)

    def _move(self, source: list[Step], target: list[Step], *, is_undo: bool) -> None:
        with self.lock:
            self.refresh()
            if not source:
                raise RefusalError(409, f"There is nothing to {'undo' if is_undo else 'redo'}.")
            step = source[-1]
            self._write(step.before if is_undo else step.after)
            try:
                scenario = self._load()
                self._check_results_stay(scenario)
                self._scenario, self._problem = scenario, ""
            except RefusalError:
                self._write(step.after if is_undo else step.before)
                raise
            except EgvsError as error:  # the step was an edit by hand
                self._problem = str(error)
            target.append(source.pop())
            self._contents = self._read()

    # ---- poles

    def check_pole(self, body: dict[str, Any]) -> str:
        """Return why a pole cannot stand at a position; empty if it can."""
        x_m, y_m = parse_number(body.get("x_m"), "x_m"), parse_number(body.get("y_m"), "y_m")
        row = self._sites_table(editable=False)[1].get(str(body.get("site")), {})
        config = self._scenario.sites
        heights_m = [float(row["z_m"])] if row.get("z_m") else list(config.heights_m or (4.0,))
        scene = self._scene()
        with self._scene_lock:
            return scene.poles.problem(
                str(body.get("site", "")), x_m, y_m, heights_m, row.get("sensor") or self._sensor
            )

    def _refuse_impossible(self, body: dict[str, Any], field_name: str = "x_m") -> None:
        if problem := self.check_pole(body):
            raise RefusalError(422, problem, "", field_name)

    def add_site(self, body: dict[str, Any]) -> str:
        """Add a pole; return its name."""
        with self.lock:
            table, rows = self._sites_table()
            name = str(body.get("site") or "").strip()
            if not name:
                name = next(f"new{number}" for number in range(1, len(rows) + 2) if f"new{number}" not in rows)
            elif name in rows:
                raise RefusalError(409, f"there is a pole {name!r}", "Choose another name.", "site")
            self._refuse_impossible(body)
            row = {"site": name}
            table.rows.append(row)
            self._fill(table, row, {key: value for key, value in body.items() if key not in ("site", *_FLAGS)})
            self._change(f"add {name}", {**self._contents, self.sites_file: table.to_text()})
            return name

    def edit_site(self, name: str, body: dict[str, Any]) -> None:
        """Change a pole: position, sensor, cost, its name, and whether it exists, must or must not be used."""
        with self.lock:
            table, rows = self._table_with(name)
            row, document = rows[name], tomlkit.parse(self._contents[SCENARIO_FILE])
            is_moved = "x_m" in body or "y_m" in body
            if is_moved:
                position = {key: body.get(key, row[key]) for key in ("x_m", "y_m")}
                self._refuse_impossible({**position, "site": name})
                if row.get("moved_m"):  # somebody has said where it stands
                    row["moved_m"] = ""
            new_name = require_text(body, "site") if "site" in body else name
            if new_name != name and new_name in rows:
                raise RefusalError(409, f"there is a pole {new_name!r}", "Choose another name.", "site")
            self._fill(table, row, {key: value for key, value in body.items() if key not in ("site", *_FLAGS)})
            row["site"] = new_name
            self._set_flags(document, name, new_name, body, row)
            if (default := self._default_sensor(table)) != self._sensor:
                document["sites"]["sensor"] = default
            after = {**self._contents, self.sites_file: table.to_text(), SCENARIO_FILE: tomlkit.dumps(document)}
            label = f"{'move' if is_moved and len(body) <= 2 else 'edit'} {name}"
            self._change(label, after, "site" if new_name != name else next(iter(body), ""))

    def remove_site(self, name: str) -> None:
        """Remove a pole."""
        with self.lock:
            table, rows = self._table_with(name)
            table.rows.remove(rows[name])
            document = tomlkit.parse(self._contents[SCENARIO_FILE])
            self._set_flags(document, name, name, dict.fromkeys(_FLAGS, False), {})
            after = {**self._contents, self.sites_file: table.to_text(), SCENARIO_FILE: tomlkit.dumps(document)}
            self._change(f"remove {name}", after)

    def exchange_sensor(self, name: str, sensor: str, file: Path) -> list[str]:
        """Write the table of poles with another sensor on one of them to a file; return the settings that use it."""
        with self.lock:
            table, rows = self._table_with(name)
            self._fill(table, rows[name], {"sensor": sensor})
            files.write_text(file, table.to_text())
            return [f"sites.file={json.dumps(str(file))}", f"sites.sensor={json.dumps(self._default_sensor(table))}"]

    def _default_sensor(self, table: CsvTable) -> str:
        """Return the sensor of ``[sites]``; that of the first pole where no pole has it any more."""
        sensors = [row.get("sensor") or self._sensor for row in table.rows]
        return self._sensor if self._sensor in sensors else sensors[0]

    @property
    def _sensor(self) -> str:
        """The sensor of ``[sites]``; the first one of several."""
        sensor = self._scenario.sites.sensor
        return sensor if isinstance(sensor, str) else sensor[0]

    @property
    def sites_file(self) -> str:
        """Name of the table of poles."""
        return self._scenario.sites.file or ""

    @property
    def digest(self) -> str:
        """Changes with each change of the files."""
        return hashlib.sha256(repr(sorted(self._contents.items())).encode()).hexdigest()

    def copy_with_run(self, target: Path) -> dict[str, str]:
        """Copy the scenario and its run to a folder; return both copies, ``scenario`` and ``run``.

        What reads them later sees neither changes of the files nor another run, and writes to neither.
        """
        shutil.rmtree(target, ignore_errors=True)
        copies = {"scenario": target / self.folder.name, "run": target / RUNS / self.folder.name}
        shutil.copytree(
            self.folder,
            copies["scenario"],
            ignore=lambda folder, names: [str(RUNS)] if Path(folder) == self.folder else [],
        )
        shutil.copytree(self.run_folder, copies["run"])
        return {name: str(copy) for name, copy in copies.items()}

    def _why_no_sites(self) -> str:
        name = self._scenario.sites.file
        if name is None:
            return "The sites come from a rule of the scenario, not from a table."
        if name not in self._contents:
            return f"The sites are in {name}, which is no CSV file in the scenario's folder."
        if not set(_POSITION_COLUMNS) <= set(CsvTable.parse(self._contents[name]).columns):
            return f"{name} has no columns site, x_m and y_m: edit it as a file."
        if isinstance(self._scenario.sites.sensor, tuple):
            return f"{SCENARIO_FILE} has several sensors for each pole: edit {name} as a file."
        return ""

    def _sites_table(self, *, editable: bool = True) -> tuple[CsvTable, dict[str, dict[str, str]]]:
        """Return the table of sites, and its rows by name."""
        if editable:
            self.refresh()
            if reason := self._problem or self._why_no_sites():
                raise RefusalError(409, reason)
        table = CsvTable.parse(self._contents.get(self.sites_file, ""))
        return table, {row.get("site", "").strip(): row for row in table.rows}

    def _table_with(self, name: str) -> tuple[CsvTable, dict[str, dict[str, str]]]:
        """Return the table of sites, which has this one, and its rows by name."""
        table, rows = self._sites_table()
        if name not in rows:
            raise RefusalError(404, f"there is no pole {name!r}")
        return table, rows

    def _fill(self, table: CsvTable, row: dict[str, str], values: dict[str, Any]) -> None:
        for key, value in values.items():
            if key in ("x_m", "y_m"):
                row[key] = repr(round(parse_number(value, key), 2))
            elif key in _OPTIONAL_NUMBERS:
                number = None if value in (None, "") else parse_number(value, key, *_OPTIONAL_NUMBERS[key])
                table.set(row, key, "" if number is None else f"{number:.12g}")
            elif key == "sensor":
                if value not in (None, "", *self._sensor_names()):
                    raise RefusalError(422, f"there is no sensor {value!r}", "", key)
                table.set(row, key, value or "")
            else:
                raise RefusalError(422, f"{key[:40]!r} cannot be set for a pole", "", key[:40])

    def _set_flags(self, document: Any, name: str, new_name: str, body: dict[str, Any], row: dict[str, str]) -> None:
        """Set whether a pole exists, must or must not be used, and its name where these are listed."""
        existing = self._scenario.sites.existing_poles
        if existing == "all" and (body.get("exists") is False or new_name != name):
            document["sites"]["existing_poles"] = list(self._sites_table(editable=False)[1])
        for flag, (table, key) in _FLAGS.items():
            listed = document.get(table, {}).get(key, [])
            if isinstance(listed, str):  # all
                continue
            names = [str(each) for each in listed]
            wanted = body.get(flag, name in names)
            if not isinstance(wanted, bool):
                raise RefusalError(422, f"expected true or false for {flag}", "", flag)
            if flag == "must" and wanted and name not in names:
                self._check_one_candidate(name, row)
            others = [each for each in names if each != name]
            if wanted:
                position = names.index(name) if name in names else len(others)
                others.insert(position, new_name)
            if others != names:
                document.setdefault(table, tomlkit.table())[key] = others

    def _check_one_candidate(self, name: str, row: dict[str, str]) -> None:
        """Refuse where a pole has several heights or tilts: a plan must know which one it is."""
        config = self._scenario.sites
        heights = 1 if row.get("z_m") else len(config.heights_m or (0.0,))
        tilts = 1 if row.get("pitch_deg") or not isinstance(config.pitch_deg, tuple) else len(config.pitch_deg)
        if heights * tilts > 1:
            problem = f"{name} has {heights * tilts} candidates: heights and tilts"
            raise RefusalError(422, problem, "Set its height and its tilt first.", "must")

    # ---- counts and settings

    def set_counts(self, body: dict[str, Any]) -> None:
        """Set vehicles per hour of some movements of a period, by their position in the table."""
        with self.lock:
            self.refresh()
            period = str(body.get("period", ""))
            if period not in self._scenario.by_period():
                raise RefusalError(404, f"there is no period {period[:40]!r}", "", "period")
            name = self._counts_file(period)
            if reason := self._problem or self._why_no_counts(name):
                raise RefusalError(409, reason)
            table, counts = CsvTable.parse(self._contents[name]), body.get("counts")
            if not isinstance(counts, dict):
                raise RefusalError(422, "expected counts by their index", "", "counts")
            for index, value in counts.items():
                if not index.isdecimal() or int(index) >= len(table.rows):
                    raise RefusalError(404, f"there is no movement {index[:20]!r}", "", index[:20])
                number = parse_number(value, index, 0.0, 1e5)
                table.rows[int(index)]["count"] = f"{number:.12g}"
            document = tomlkit.parse(self._contents[SCENARIO_FILE])
            for number, text in enumerate(document.get("assumed", [])):
                if str(text).startswith("traffic ("):
                    document["assumed"][number] = _UNCOUNTED
            self._change("counts", {**self._contents, name: table.to_text(), SCENARIO_FILE: tomlkit.dumps(document)})

    def _why_no_counts(self, name: str) -> str:
        return "" if name in self._contents else "There is no table of counts in the scenario's folder."

    def _describe_counts(self, network: Network | None) -> list[dict[str, Any]]:
        return [
            {"period": name, "reason": self._why_no_counts(self._counts_file(name) if period.traffic.counts else "")}
            | traffic_view.describe_movements(period, network)
            for name, period in self._scenario.by_period().items()
        ]

    def set_signals(self, body: dict[str, Any]) -> None:
        """Set the green times of a signal in its table, and yellow and all-red in its plan."""
        with self.lock:
            self.refresh()
            signal = {each["name"]: each for each in self._describe_signals()}.get(str(body.get("name")))
            greens = body.get("green_s")
            if signal is None or not signal["phases"]:
                raise RefusalError(409, self._problem or "there is no table of such a signal")
            if not isinstance(greens, list) or len(greens) != len(signal["phases"]):
                raise RefusalError(422, f"expected {len(signal['phases'])} green times", "", "green_s")
            document = tomlkit.parse(self._contents[SCENARIO_FILE])
            plan: Any = document["traffic"]["signals"][signal["name"]]
            for key in ("yellow_s", "all_red_s"):
                value = parse_number(body.get(key), key, 0.0, 300.0)
                if value != signal[key]:
                    plan[key] = value
            table = CsvTable.parse(self._contents[signal["file"]])
            for number, (green_s, phase) in enumerate(zip(greens, signal["phases"], strict=True)):
                value = parse_number(green_s, f"green_s.{number}", 1.0, 300.0)
                for row in table.rows:
                    if row.get("phase") == phase["name"]:
                        row["green_s"] = f"{value:.12g}"
            after = {**self._contents, signal["file"]: table.to_text(), SCENARIO_FILE: tomlkit.dumps(document)}
            self._change("signals", after, "green_s")

    def _describe_signals(self) -> list[dict[str, Any]]:
        tables = {name: CsvTable.parse(text).rows for name, text in self._contents.items() if name.endswith(".csv")}
        return traffic_view.describe_signals(self._scenario, tables)

    @property
    def obstacles(self) -> list[dict[str, Any]]:
        """What could stand in the way."""
        return obstacles.describe_obstacles(self._scenario)

    def set_obstacles(self, body: dict[str, Any]) -> None:
        """Set what could stand in the way, for ``egvs what-if``."""
        with self.lock:
            self.refresh()
            document = tomlkit.parse(self._contents[SCENARIO_FILE])
            obstacles.write_obstacles(document, body.get("obstacles"))
            self._change("obstacles", {**self._contents, SCENARIO_FILE: tomlkit.dumps(document)}, "obstacles")

    def set_settings(self, body: dict[str, Any]) -> None:
        """Set keys of the scenario."""
        with self.lock:
            self.refresh()
            document = tomlkit.parse(self._contents[SCENARIO_FILE])
            for key, value in body.items():
                if key not in _SETTINGS:
                    raise RefusalError(422, f"{key[:40]!r} cannot be set here", "", key[:40])
                *tables, last = _SETTINGS[key]
                table: Any = document
                for name in tables:
                    table = table.setdefault(name, tomlkit.table())
                table[last] = self._setting(key, value)
            self._change("settings", {**self._contents, SCENARIO_FILE: tomlkit.dumps(document)})

    def _setting(self, key: str, value: Any) -> Any:
        if key == "sensor":
            if value not in self._sensor_names():
                raise RefusalError(422, f"there is no sensor {str(value)[:40]!r}", "", key)
            return value
        if key in ("heights_m", "pitch_deg"):
            values = value if isinstance(value, list) else [value]
            return ["aim" if each == "aim" and key == "pitch_deg" else parse_number(each, key) for each in values]
        if key == "sensor_costs" and isinstance(value, dict):
            if unknown := set(value) - set(self._sensor_names()):
                raise RefusalError(422, f"there is no sensor {min(unknown)[:40]!r}", "", key)
            given = {name: parse_number(cost, key, 0.0) for name, cost in value.items()}
            return {**self._scenario.costs.sensor, **given}
        number = parse_number(value, key, 0.0)
        if key in _WHOLE:
            if number != int(number):
                raise RefusalError(422, f"expected a whole number, got {value!r}", "", key)
            return int(number)
        return number

    def _sensor_names(self) -> list[str]:
        return [*self._scenario.sensors, *CATALOGUE]

    # ---- what the page shows

    def _scene(self) -> _Scene:
        scenario = self._scenario
        texts = [self._contents[SCENARIO_FILE]]
        stamps = [
            (path.name, status.st_size, status.st_mtime_ns)
            for path in sorted(self.folder.iterdir())
            if path.is_file()
            and path.name not in self._contents
            and path.stem != aerial.STEM
            and (status := path.stat())
        ]
        key = hashlib.sha256(repr((texts, stamps)).encode()).hexdigest()[:16]
        with self.lock:
            if self._kept_scene is None or self._kept_scene.key != key:
                self._kept_scene = _Scene(key, Inputs(scenario))
            return self._kept_scene

    def save_picture(self, picture: aerial.AerialPicture) -> None:
        """Keep the part of an aerial picture that the map shows; it changes no result, and undo leaves it."""
        frame = geolocation.scenario_georeference(self._scenario).frame
        picture.save(self.folder, frame, self.map()["bounds_m"])

    def map(self) -> dict[str, Any]:
        """Return the map for the page."""
        scene = self._scene()
        with self._scene_lock:
            return _refused(lambda: {"key": scene.key, **scene.view})

    def suggestions(self) -> dict[str, Any]:
        """Return free positions along the kerbs."""
        scene = self._scene()
        with self._scene_lock:
            return _refused(lambda: {"poles": scene.suggestions})

    @property
    def scenario(self) -> Scenario:
        """The scenario as it is now."""
        return self._scenario

    def run_state(self) -> dict[str, Any]:
        """Return the state of the run, with the present files."""
        record = RunFolder(self.run_folder)
        stamps = [path.stat().st_mtime_ns for path in (record.run_record, record.placement) if path.is_file()]
        key = (stamps, dict(self._contents))
        if self._run_state[0] != key:
            self._run_state = key, results_view.describe_run(self.run_folder, self._scenario)
        return self._run_state[1]

    def to_json(self) -> dict[str, Any]:
        """Return the state for the page."""
        with self.lock:
            self.refresh()
            scenario, config = self._scenario, self._scenario.sites
            scene = self._scene()
            try:
                counts = self._describe_counts(scene.inputs.network)
            except EgvsError as error:
                counts = self._describe_counts(None)
                self._problem = self._problem or str(error)
            settings = scenario.traffic
            return {
                "id": self.identifier, "name": scenario.name, "title": scenario.description or scenario.name,
                "assumed": list(scenario.assumed), "notes": self.notes, "problem": self._problem,
                "files": {name: hashlib.sha256(text.encode()).hexdigest() for name, text in self._contents.items()},
                "roi": {"center_m": scenario.roi.center_m, "size_m": scenario.roi.size_m},
                "map_key": scene.key, "aerial": aerial.describe_picture(self.folder),
                "mounts": {
                    "sensor": self._sensor, "heights_m": list(config.heights_m or ()),
                    "pitch_deg": list(config.pitch_deg) if isinstance(config.pitch_deg, tuple) else [config.pitch_deg],
                },
                "sensors": self._sensor_names(),
                "sites_editable": not self._why_no_sites(), "sites_reason": self._why_no_sites(),
                "sites": self._describe_sites(),
                "counts": counts, "signals": self._describe_signals(), "obstacles": self.obstacles,
                "settings": {
                    "frames": settings.frames, "frame_period_s": settings.frame_period_s,
                    "traffic_s": None if settings.frames is None else settings.frames * settings.frame_period_s,
                },
                "costs": results_view.describe_costs(scenario, self._read_candidates()),
                "run": {"id": self.run_folder.name, **self.run_state()},
                "undo": self._undo[-1].label if self._undo else None,
                "redo": self._redo[-1].label if self._redo else None,
            }  # fmt: skip

    def _describe_sites(self) -> list[dict[str, Any]]:
        placement, existing = self._scenario.placement, self._scenario.sites.existing_poles
        described = []
        for row in self._site_rows():
            name, source = str(row["site"]), str(row.get("source") or "")
            numbers = {key: _number_or_none(row.get(key)) for key in (*_OPTIONAL_NUMBERS, "moved_m")}
            described.append({
                "site": name, "x_m": float(row["x_m"]), "y_m": float(row["y_m"]), "source": source, **numbers,
                "sensor": row.get("sensor") or None, "moved_m": numbers["moved_m"] or 0.0,
                "kind": name.rstrip("0123456789") if source and _OF_MAP_NAME.fullmatch(name) else "",
                "exists": sites.pole_exists(name, existing),
                "must": name in placement.forced, "must_not": name in placement.excluded,
            })  # fmt: skip
        return described

    def _read_candidates(self) -> tuple[sites.Site, ...]:
        """Return the candidates of the scenario; none where they cannot be read."""
        try:
            if self._candidates[0] is not self._scenario:
                self._candidates = self._scenario, sites.candidate_sites(self._scenario)
        except InputError as error:
            self._problem = self._problem or str(error)
            return ()
        return self._candidates[1]

    def _site_rows(self) -> list[dict[str, Any]]:
        """Return the rows of the table, else the poles of the scenario; empty where they cannot be read."""
        try:
            if not self._why_no_sites():
                world = geolocation.scenario_georeference(self._scenario)
                return [row.columns for row in site_files.read_table(self.folder / self.sites_file, world)[0]]
        except InputError as error:
            self._problem = self._problem or str(error)
            return []
        poles = {each.pole: each for each in self._read_candidates()}
        return [{"site": name, "x_m": each.pose.x_m, "y_m": each.pose.y_m} for name, each in poles.items()]


def _number_or_none(value: Any) -> float | None:
    number = number_or_nan(str(value))
    return number if math.isfinite(number) else None


_FLAGS = {
    "exists": ("sites", "existing_poles"),
    "must": ("placement", "forced"),
    "must_not": ("placement", "excluded"),
}
"""Keys of the scenario that list poles, by what the page calls them."""


def _refused(make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    try:
        return make()
    except EgvsError as error:
        raise RefusalError.of(error) from None
