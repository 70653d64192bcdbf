"""The page of a comparison with measured sweeps or labels, as values, as a file, and as a section of a run's report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.cli.console import Column
from egvs.core import files
from egvs.drawing import pages
from egvs.extensions.validation.files import MEASURED
from egvs.runs.command_results import add_to_report
from egvs.scenario.model import Scenario

JSON_FILE, PAGE_FILE = "against.json", "against.html"
TEMPLATES = Path(__file__).parent.parent / "templates"

Row = TypeVar("Row")


@dataclass(frozen=True)
class PageTable:
    """A table in words; ``numbers`` says which columns are numbers."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numbers: tuple[bool, ...]

    @classmethod
    def of(cls, title: str, columns: Sequence[Column[Row]], rows: Sequence[Row]) -> PageTable:
        """Return a table of the terminal."""
        return cls(
            title,
            tuple(column.title for column in columns),
            tuple(tuple(column.text(row) for column in columns) for row in rows),
            tuple(column.align == "right" for column in columns),
        )


@dataclass(frozen=True)
class MeasuredPage:
    """A part of the page: heading, first sentence, figure (SVG) with its caption, tables, sentences, sensor (TOML)."""

    heading: str
    lede: str
    figure: str
    caption: str
    tables: tuple[PageTable, ...]
    sentences: tuple[str, ...]
    sensor: str = ""


def write_pages(
    parts: Sequence[MeasuredPage], values: Any, over: str, folder: Path, scenario: Scenario | None
) -> list[Path]:
    """Write values as JSON and the page; in the folder of a run, also the section of its report; return the files.

    Parameters
    ----------
    parts
        Parts of the page.
    values
        JSON values.
    over
        What stands above the title.
    folder
        Where the files are written.
    scenario
        World of the comparison; a section is added to runs of this scenario; None adds it to any run.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    title = "Compared with measured sweeps"
    written = [folder / JSON_FILE, folder / PAGE_FILE]
    files.ensure_writable_folder(written[0])
    files.write_text(written[0], files.to_json_text(values, indent=1) + "\n")
    environment = pages.page_environment(TEMPLATES)
    text = pages.render(environment, "against.html.j2", section=parts, title=title, over=over)
    files.write_text(written[1], text)
    if RunFolder(folder).has_record:
        is_of_run = scenario is None or RunRecord.read(folder).scenario.get("name") == scenario.name
        if is_of_run:
            entry = {over: {"parts": [asdict(part) for part in parts]}}
            written += add_to_report(folder, MEASURED, entry, () if scenario is None else ("statics",))
    return written
