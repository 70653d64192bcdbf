"""What one can take along from a run, each made by the command that makes it on the command line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from egvs.artefacts.run_folder import RunFolder
from egvs.cli.commands import MODULES, PANELS, extension_commands
from egvs.core import plugins
from egvs.export.export import EXPORT_FOLDER, FORMATS


@dataclass(frozen=True)
class Download:
    """Something to take along.

    Attributes
    ----------
    identifier, title
        Its name in addresses, and for people.
    words
        The command that makes it, without the run; empty if it is there already.
    made
        What the command writes, relative to the run folder: a file, a folder, or a pattern.
    libraries, extra
        Optional libraries that it needs, and the extra of this package that installs them.
    needs_command
        Command of an extension that makes it.
    """

    identifier: str
    title: str
    words: tuple[str, ...] = ()
    made: str = ""
    libraries: tuple[str, ...] = ()
    extra: str = ""
    needs_command: str = ""

    def reason(self, commands: set[str]) -> str:
        """Return why it cannot be made; empty if it can."""
        if self.needs_command and self.needs_command not in commands:
            return f"the command egvs {self.needs_command} is not installed"
        missing = [name for name in self.libraries if find_spec(name) is None]
        return f"{', '.join(missing)} is not installed: pip install 'egvs[{self.extra}]'" if missing else ""

    def files(self, run: Path) -> list[Path]:
        """Return the files that were made, the latest first."""
        found = [path for path in run.glob(self.made) if not path.is_symlink()] if self.made else []
        files = [path for path in found if path.is_file()]
        files += [path for folder in found if folder.is_dir() for path in folder.rglob("*") if path.is_file()]
        return sorted(files, key=lambda path: -path.stat().st_mtime)


_TITLES = {
    "gpkg": "GeoPackage", "dxf": "Site plan (DXF)", "glb": "3D scene (glTF)", "kml": "Google Earth (KML)",
    "geojson": "GeoJSON", "csv": "Tables (CSV)",
}  # fmt: skip


def list_downloads() -> Iterator[Download]:
    """Yield everything that a run offers."""
    yield Download("report", "Report", (), RunFolder.report.name)
    page = f"{EXPORT_FOLDER}/view.html"
    yield Download("page", "3D view as one page", ("explore", "--to", page), page, ("viser", "PIL"), "explore")
    yield Download("sheets", "Installation sheets", ("sheets",), "sheets", needs_command="sheets")
    for name, title in _TITLES.items():
        kind = FORMATS[name]
        made = f"{EXPORT_FOLDER}/*{kind.suffix}" if kind.is_one_file else f"{EXPORT_FOLDER}/{name}"
        yield Download(name, title, ("export", "--to", name), made, kind.libraries, kind.extra)


def find_download(identifier: str) -> Download | None:
    """Return a download by its name."""
    return next((each for each in list_downloads() if each.identifier == identifier), None)


def command_names() -> set[str]:
    """Return the names of all commands of the command line."""
    names = {name for panel in PANELS.values() for name in panel} | set(MODULES)
    for extension in plugins.plugin_names("egvs.commands"):
        names |= set(extension_commands(extension))
    return names


def describe_downloads(run: Path | None, project_name: str) -> dict[str, Any]:
    """Return the menu for the page; ``run`` is None without a finished run."""
    commands = command_names()
    items = []
    for each in list_downloads():
        reason = each.reason(commands) if run is not None else "there is no finished run"
        items.append({
            "id": each.identifier, "title": each.title, "available": not reason, "reason": reason,
        })  # fmt: skip
    items.append({"id": "scenario", "title": f"Scenario {project_name} as one file", "available": True,
                  "reason": ""})  # fmt: skip
    return {"items": items}
