"""Commands that take a scenario or a run folder: which settings they use, and what has changed since a run.

Notes go to standard error, before the work begins.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egvs.cli.value_text import format_value
from egvs.core.wording import by_number, list_first

if TYPE_CHECKING:
    from egvs.runs.run_sources import SettingsSource
    from egvs.scenario.model import Scenario

MAX_KEYS = 6
"""Settings that a note lists."""


def open_source(
    path: Path, overrides: Sequence[str] | None, out: Path | None, request: Sequence[str] = ()
) -> tuple[Scenario, Path]:
    """Return the scenario of a command and its run folder; print how its settings differ from those of a run.

    Parameters
    ----------
    path
        A scenario, or a run folder.
    overrides, out
        ``--set`` and ``--out``.
    request
        Overrides by the options of ``egvs place``, by which the run folder does not change.

    Raises
    ------
    InputError
        When the scenario or the record of the run is not valid, or a run folder is given with overrides or ``out``.
    """
    from egvs.runs.run_sources import SettingsSource

    source = SettingsSource.of(path, overrides, out)
    scenario = source.load_with_request(request)
    folder = source.folder(scenario, out)
    print_notes(source, scenario, folder)
    return scenario, folder


def print_notes(source: SettingsSource, scenario: Scenario, folder: Path) -> None:
    """Print which settings and files of a run have changed since, or how a scenario differs from its latest run.

    Parameters
    ----------
    source
        The scenario or run.
    scenario, folder
        From the source.
    """
    from egvs.runs import run_list, run_sources

    if not source.is_run:
        latest = run_list.latest_difference(scenario, folder)
        if latest is not None and latest[1]:
            _say(f"settings differ from the latest run, {latest[0]}: {_describe_differences(latest[1])}")
        return
    if edited := run_sources.edited_settings(scenario):
        _say(f"the settings of {folder} are used; {scenario.file} now differs in {list_first(edited, MAX_KEYS)}")
    if changed := run_sources.changed_files(folder, scenario):
        files = f"{list_first(changed, MAX_KEYS)} {by_number(len(changed), 'has', 'have')}"
        _say(f"warning: {files} changed since the run in {folder}: its stages run again as needed")


def run_arguments(path: Path, overrides: Sequence[str] | None, out: Path | None) -> tuple[Path, list[str], Path | None]:
    """Return scenario, overrides and folder with which ``egvs run`` has the settings of a command.

    Parameters
    ----------
    path, overrides, out
        As of :func:`open_source`.
    """
    from egvs.runs.run_sources import SettingsSource
    from egvs.scenario.settings import format_overrides

    source = SettingsSource.of(path, overrides, out)
    if not source.is_run:
        return path, list(overrides or ()), out
    scenario = source.load()
    return scenario.folder, format_overrides(scenario.overrides), None


def _describe_differences(differences: dict[str, tuple[Any, Any]]) -> str:
    texts = []
    for key, (there, here) in differences.items():
        texts.append(f"{key} ({format_setting(key, there)} there, {format_setting(key, here)} here)")
    return list_first(texts, MAX_KEYS)


def format_setting(key: str, value: Any) -> str:
    """Return a setting as text: an effect without other parameters as "on" or "off", an empty value as "none"."""
    from egvs.scenario.settings import effect_state

    if state := effect_state(key, value):
        return state
    if value is None or value in ([], {}):
        return "none"
    return format_value(value)


def _say(line: str) -> None:
    print(line, file=sys.stderr)
