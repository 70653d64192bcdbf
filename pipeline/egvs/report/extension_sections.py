"""Sections of the page that extensions provide: entry points of the group ``egvs.report_sections``.

A section shows what a command of the extension found for a run. It has a template and files of the run folder, and may
warn at the head of the page and at the end of ``egvs run``. All that it can show counts in the key of the report
(:func:`section_dependencies`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import StageRecord
from egvs.core import files, plugins
from egvs.scenario.model import Scenario

GROUP = "egvs.report_sections"
"""The group of entry points."""


class SectionWarning(NamedTuple):
    """Why a reader should not trust the answer of a run.

    Attributes
    ----------
    sentence
        For a terminal: "The validation contradicts the ranking: with cluster, c01 is better."
    headline
        Follows the headline of the page and "but": "the validation contradicts this".
    reason
        A clause: "with cluster, c01 is better".
    link
        Text of the link to the section: "validation".
    """

    sentence: str
    headline: str
    reason: str
    link: str


@runtime_checkable
class ReportSection(Protocol):
    """A section of the page.

    Attributes
    ----------
    name
        Its name, which is that of the anchor to which its warnings link.
    files
        Names of the files in the run folder that it shows.
    template
        Path of its template, which has the values of :meth:`read` as ``section``, and what the page itself has.
    """

    name: str
    files: tuple[str, ...]
    template: Path

    def read(self, folder: RunFolder, scenario: Scenario, stages: Mapping[str, StageRecord]) -> Any | None:
        """Return what the template shows; None if the folder has nothing that belongs to these stages."""

    def warnings(self, values: Any) -> Iterator[SectionWarning]:
        """Yield warnings about the answer of the run."""


@dataclass(frozen=True)
class SectionContents:
    """A section, and its values for a run."""

    section: ReportSection
    values: Any

    @property
    def template(self) -> str:
        """Name of the template for the loader of the page."""
        return template_name(self.section)

    @property
    def warnings(self) -> tuple[SectionWarning, ...]:
        """Warnings about the answer of the run."""
        return tuple(self.section.warnings(self.values))


def template_name(section: ReportSection) -> str:
    """Return the name under which the page includes the template of a section."""
    return f"{section.name}/{section.template.name}"


@cache
def report_sections() -> tuple[ReportSection, ...]:
    """Return the sections of all extensions, in the order of their entry points.

    Raises
    ------
    MissingBackendError
        When an entry point cannot be loaded, or is no :class:`ReportSection`.
    """
    expected = "an object with name, files, template, read and warnings, see ReportSection"
    return plugins.load_plugins(GROUP, ReportSection, expected)  # type: ignore[type-abstract]


def section_modules() -> tuple[str, ...]:
    """Return the modules of the sections, which determine the page although it does not import them."""
    return tuple(plugins.plugin_module(GROUP, name) for name in plugins.plugin_names(GROUP))


def section_dependencies(folder: RunFolder, scenario: Scenario, stages: Mapping[str, StageRecord]) -> dict[str, Any]:
    """Return what the sections depend on, apart from files of the run folder and their modules.

    These are their templates. Where a section has a file to show, what belongs to the run depends on the scenario and
    on the inputs of its stages.
    """
    sections = report_sections()
    values: dict[str, Any] = {
        "templates": {template_name(section): files.hash_file(section.template) for section in sections}
    }
    if any((folder / name).is_file() for section in sections for name in section.files):
        values["scenario"] = files.hash_json(scenario.model_dump(mode="json"))
        values["stages"] = {name: stage.inputs for name, stage in stages.items()}
    return values


def read_sections(
    folder: RunFolder, scenario: Scenario, stages: Mapping[str, StageRecord]
) -> tuple[SectionContents, ...]:
    """Return the sections that have something to show.

    Parameters
    ----------
    folder
        The run folder.
    scenario
        The scenario of the run.
    stages
        Records of the stages of the run.
    """
    contents = (SectionContents(section, section.read(folder, scenario, stages)) for section in report_sections())
    return tuple(content for content in contents if content.values is not None)
