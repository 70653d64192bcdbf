"""The folder that ``egvs desk`` opens: its scenarios and runs, maps that were dropped, and which paths may be used."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egvs.artefacts.run_folder import RUNS
from egvs.core import readers
from egvs.core.errors import EgvsError, InputError
from egvs.creation import map_readers, scenario_files
from egvs.extensions.desk.aerial import AerialPicture, describe_picture
from egvs.extensions.desk.refusals import RefusalError
from egvs.formats.archives import unpack_archives
from egvs.formats.georeference import WorldFrame
from egvs.results.labels import SCORE_LABELS
from egvs.runs import run_list
from egvs.scenario import shipped
from egvs.scenario.loading import load
from egvs.scenario.model import SCENARIO_FILE

_NAME = re.compile(r"[^/\\:*?\"<>|\x00-\x1f\x7f.~][^/\\:*?\"<>|\x00-\x1f\x7f]{0,79}")
MOST_LISTED = 200
MOST_MAPS = 20


@dataclass
class DroppedMap:
    """A map that the page has sent; ``streets`` is the file of what was read."""

    identifier: str
    name: str
    path: Path
    state: str = "uploaded"
    message: str = ""
    picture: AerialPicture | None = None

    @property
    def streets(self) -> Path:
        """What was read of it."""
        return self.path.parent / "streets.json"

    def save_picture(self, picture: AerialPicture) -> None:
        """Keep an aerial picture, and the part of it that the map shows."""
        streets = json.loads(self.streets.read_text(encoding="utf-8"))
        frame = None if streets["frame"] is None else WorldFrame(*streets["frame"])
        picture.save(self.path.parent, frame, streets["bounds_m"])
        if self.picture is not None:
            shutil.rmtree(self.picture.path.parent)
        self.picture = picture

    def to_json(self, *, with_streets: bool = False) -> dict[str, Any]:
        """Return what the page shows."""
        values: dict[str, Any] = {
            "id": self.identifier, "name": self.name, "state": self.state, "message": self.message,
            "aerial": describe_picture(self.path.parent),
        }  # fmt: skip
        if with_streets and self.state == "read":
            values["streets"] = json.loads(self.streets.read_text(encoding="utf-8"))
        return values


class Workspace:
    """A folder with scenarios, and their runs in ``runs``.

    Parameters
    ----------
    folder
        The folder; it may be a scenario itself, whose name is then ``"."``.
    scratch
        A temporary folder for what the page sends and takes.
    """

    def __init__(self, folder: Path, scratch: Path) -> None:
        self.folder, self.scratch = folder.resolve(), scratch
        self.maps: dict[str, DroppedMap] = {}
        self._numbers = itertools.count(1)

    def scenario_folder(self, identifier: str) -> Path:
        """Return the folder of a scenario; RefusalError for an unknown name."""
        if identifier == "." and (self.folder / SCENARIO_FILE).is_file():
            return self.folder
        folder = self.folder / identifier
        is_inside = _NAME.fullmatch(identifier) and folder.resolve().parent == self.folder
        if not is_inside or not (folder / SCENARIO_FILE).is_file():
            raise RefusalError(404, f"there is no scenario {identifier[:80]!r}", "", "scenario")
        return folder

    def run_folder(self, scenario_name: str) -> Path:
        """Return the folder of the run of a scenario, as ``egvs run`` in the folder."""
        if not _NAME.fullmatch(scenario_name):
            raise RefusalError(422, f"{scenario_name[:80]!r} cannot be the name of a run", "", "name")
        return self.folder / RUNS / scenario_name

    def new_folder(self, name: str) -> Path:
        """Return the folder of a new scenario; RefusalError if the name is not free."""
        if not _NAME.fullmatch(name) or name == str(RUNS):
            problem = f"{name[:80]!r} cannot be the name of a scenario"
            raise RefusalError(422, problem, "Use up to 80 letters and digits.", "name")
        folder = self.folder / name
        try:
            scenario_files.check_new_folder(folder)
        except InputError as error:
            raise RefusalError(409, f"{name}: {error.problem}", "Choose another name.", "name") from None
        return folder

    def copy_shipped(self, name: str, new_name: str) -> None:
        """Copy a scenario that comes with this program."""
        if name not in shipped.shipped_names():
            raise RefusalError(404, f"there is no shipped scenario {name[:80]!r}", "", "shipped")
        shipped.copy_scenario(name, self.new_folder(new_name))

    # ---- lists

    def describe(self) -> dict[str, Any]:
        """Return what the start page lists."""
        folders = [path for path in sorted(self.folder.iterdir()) if (path / SCENARIO_FILE).is_file()]
        names = [path.name for path in folders if _NAME.fullmatch(path.name)][:MOST_LISTED]
        if (self.folder / SCENARIO_FILE).is_file():
            names.insert(0, ".")
        has_runs = (self.folder / RUNS).is_dir()
        runs = [self._describe_run(run) for run in run_list.list_runs(self.folder / RUNS)] if has_runs else []
        states = {run["name"]: run for run in runs}
        return {
            "folder": str(self.folder),
            "scenarios": [self._describe_scenario(name, states) for name in names],
            "runs": runs[:MOST_LISTED],
            "shipped": [
                {"id": name, "description": load(shipped.shipped_scenario(name)).description}
                for name in shipped.shipped_names()
            ],
            "map_kinds": [*map_suffixes(), ".zip"],
            "maps": [dropped.to_json() for dropped in self.maps.values()],
        }

    def _describe_scenario(self, name: str, runs: dict[str, dict[str, Any]]) -> dict[str, Any]:
        path = self.folder / name / SCENARIO_FILE
        values: dict[str, Any] = {
            "id": name, "name": name, "description": "", "run": None, "problem": ""
        }  # fmt: skip
        try:
            scenario = load(path)
            values |= {"name": scenario.name, "description": scenario.description}
        except EgvsError as error:
            values["problem"] = str(error)
        if run := runs.get(values["name"]):
            values["run"] = {"id": run["id"], "state": "partial" if run["missing"] else "complete"}
        return values

    def _describe_run(self, run: run_list.ListedRun) -> dict[str, Any]:
        best = run.best
        scenario = run.scenario.resolve()
        is_here = scenario.parent == self.folder or scenario == self.folder
        return {
            "id": f"{RUNS}/{run.folder.name}", "name": run.folder.name,
            "scenario": ("." if scenario == self.folder else scenario.name) if is_here else None,
            "best": best.names[0] if best else None,
            "score_text": SCORE_LABELS[best.rank_by].with_unit(best.score) if best else "",
            "problem": run.problem, "missing": list(run.missing),
        }  # fmt: skip

    # ---- maps and archives

    def begin_upload(self, name: str, suffixes: tuple[str, ...]) -> Path:
        """Return where an upload is written; RefusalError for a name of another kind of file."""
        if not name.lower().endswith(suffixes):
            hint = f"Kinds: {', '.join(suffixes)}."
            raise RefusalError(415, f"{name[:80]!r} is no file of a known kind", hint, "name")
        if len(self.maps) >= MOST_MAPS:
            raise RefusalError(409, f"there are {MOST_MAPS} maps already", "Start the desk again.")
        folder = self.scratch / f"upload{next(self._numbers)}"
        folder.mkdir()
        suffix = next(each for each in suffixes if name.lower().endswith(each))
        return folder / f"map{suffix}"

    def add_map(self, name: str, path: Path) -> DroppedMap:
        """Take over an uploaded map; RefusalError if no reader knows its content, or it has no roads."""
        try:
            if path.suffix.lower() != ".zip" and map_readers.ROADS not in map_readers.find_reader(path).gives:
                raise RefusalError(415, f"{name[:80]} is a map without roads", "Drop a map of streets.", "name")
        except InputError as error:
            shutil.rmtree(path.parent)
            raise RefusalError(415, f"{name[:80]}: {error.problem}", error.hint, "name") from None
        dropped = DroppedMap(f"m{len(self.maps) + 1}", name[:80], path)
        self.maps[dropped.identifier] = dropped
        return dropped

    def import_scenario(self, name: str, archive: Path) -> str:
        """Unpack a scenario that somebody sent, in a confined process; return its name here."""
        new_name = re.sub(r"\.zip$", "", name, flags=re.IGNORECASE)
        folder = self.new_folder(new_name)
        with unpack_archives([archive]) as unpacked:
            found = sorted(unpacked.paths[0].rglob(SCENARIO_FILE), key=lambda path: len(path.parts))
            if not found:
                raise RefusalError(415, f"{name[:80]} has no {SCENARIO_FILE}", "Drop a scenario from the menu.", "name")
            load(found[0])
            shutil.copytree(found[0].parent, folder, symlinks=True)
        return new_name

    def pack(self, folder: Path, target: Path) -> Path:
        """Write the files of a folder, without hidden ones and runs, to an archive."""
        with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted(folder.rglob("*")):
                parts = path.relative_to(folder).parts
                if path.is_file() and not path.is_symlink() and parts[0] != str(RUNS) and not parts[-1].startswith("."):
                    archive.write(path, Path(*parts))
        return target


def map_suffixes() -> list[str]:
    """Return the endings of names of maps with roads."""
    known = [suffix for each in readers.list_readers(map_readers.KIND) if map_readers.ROADS in each.gives
             for suffix in each.suffixes]  # fmt: skip
    return list(dict.fromkeys(known))
