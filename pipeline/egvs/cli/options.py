"""Options that several verbs share, and parsers of option values with units."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from typer.core import TyperCommand

from egvs.core.errors import InputError
from egvs.core.numbers import ambiguous_number, number_or_nan

ScenarioPath = Annotated[
    Path,
    typer.Argument(
        metavar="SCENARIO", help="Scenario folder, or its scenario.toml; or a shipped scenario, e.g. nishishinjuku."
    ),
]
SettingsPath = Annotated[
    Path,
    typer.Argument(metavar="SCENARIO|RUN", help="Scenario folder or its scenario.toml, or a run, to use its settings."),
]
Run = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run.")]


def _check_folder_name(folder: Path | None) -> Path | None:
    """Raise an InputError for the name of a page in place of a run folder."""
    if folder is not None and folder.suffix.lower() in (".html", ".htm"):
        problem = f"expected the folder of the run, got {folder}"
        raise InputError(
            "--out", problem, f"For one page with the 3D view, use egvs explore --to {shlex.quote(str(folder))}."
        )
    return folder


Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="DIR",
        callback=_check_folder_name,
        help="Folder of the run; by default runs/<scenario name>, with --set runs/<scenario name>@<what differs>.",
    ),
]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a scenario key, e.g. traffic.frames=500 (repeatable)."),
]
Detector = Annotated[
    str | None,
    typer.Option(
        "--detector",
        metavar="NAME",
        help="Detector that expected_detections stands for: cluster, pointpillars, all (their mean, the default), or "
        "pointpillars_sensor, which measures heights from the sensor; all_uncorrected: before the correction for "
        "streets. Short for --set score.detector=NAME.",
    ),
]
Jobs = Annotated[
    int | None, typer.Option("--jobs", min=1, help="Number of threads or processes; one per core by default.")
]
Top = Annotated[
    int | None, typer.Option("--top", metavar="N", min=1, help="Print only the best N sites; all by default.")
]
Verbose = Annotated[
    bool, typer.Option("--verbose", help="Print all details of each stage, all warnings, the files and their cost.")
]
Rehash = Annotated[
    bool,
    typer.Option("--rehash", help="Hash every file again, and make scans, TPOG and scores again to compare them."),
]
Audit = Annotated[
    bool, typer.Option("--audit", help="Check the voxel traversal of every beam, and print the worst deviation.")
]


def with_detector(overrides: Sequence[str] | None, detector: str | None, path: Path | None = None) -> list[str]:
    """Return the overrides of ``--set`` with that of ``--detector``.

    Parameters
    ----------
    overrides, detector
        Values of the two options.
    path
        Scenario or run folder of a command that does not accept overrides for a run folder.

    Raises
    ------
    InputError
        For an unknown detector, one that ``--set`` chooses too, or a run folder.
    """
    if detector is None:
        return list(overrides or ())

    from egvs.runs.run_sources import SettingsSource
    from egvs.scenario.score_config import DetectorChoice

    known = get_args(DetectorChoice)
    if detector not in known:
        problem = f"expected {', '.join(known[:-1])} or {known[-1]}, got {detector[:80]!r}"
        raise InputError("--detector", problem, f"Use --detector {known[0]}.")
    if any(override.partition("=")[0].strip() == "score.detector" for override in overrides or ()):
        raise InputError("--detector", "cannot be used with --set score.detector", "Remove one of the two options.")
    if path is not None and SettingsSource(path).is_run:
        raise InputError("--detector", f"cannot be used with a run folder ({path})", "Give the scenario instead.")
    return [*(overrides or ()), f"score.detector={detector}"]


def duration_s(text: str, option: str = "--budget") -> float:
    """Return seconds from 90s, 10m or 1.5h."""
    seconds = _parse_quantity(text, {"s": 1.0, "m": 60.0, "h": 3600.0, "": 1.0})
    if not 0 < seconds < math.inf:
        raise InputError(option, f"expected a time above 0, got {text!r}", "Use a time such as 90s, 10m or 1.5h.")
    return seconds


def heights_m(text: str) -> tuple[float, float]:
    """Return the two heights of ``--heights LOW,HIGH`` in metres."""
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?),([0-9]+(?:\.[0-9]+)?)", text)
    if match:
        low, high = float(match[1]), float(match[2])
        if 0 < low <= high <= 100:
            return low, high
    raise InputError("--heights", f"expected LOW,HIGH in metres, got {text!r}", "Use heights such as 2,7.")


def size_bytes(text: str) -> float:
    """Return the bytes of ``--max``, e.g. 500M or 2G."""
    size = _parse_quantity(text.removesuffix("B"), {"": 1.0, "K": 1e3, "M": 1e6, "G": 1e9, "T": 1e12})
    if math.isnan(size):
        raise InputError("--max", f"expected a size, got {text!r}", "Use a size such as 500M or 2G.")
    return size


def parse_host_and_port(text: str) -> tuple[str, int]:
    """Return host and port of ``--traci HOST:PORT``."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise InputError("--traci", f"expected HOST:PORT, got {text!r}", "Use an address such as localhost:8813.")
    return host, int(port)


def latitude_and_longitude(text: str, option: str = "--at") -> tuple[float, float]:
    """Return latitude and longitude in degrees from LAT,LON, also from "LAT LON" and with decimal commas.

    Examples
    --------
    >>> latitude_and_longitude("52.2724,8.0405"), latitude_and_longitude("52,2724 8,0405")
    ((52.2724, 8.0405), (52.2724, 8.0405))
    """
    words = re.split(r"[\s;]+", text.strip())
    if len(words) == 2:
        words = [word.removesuffix(",").replace(",", ".") for word in words]
    else:
        words = text.split(",")
        if len(words) == 4:  # decimal commas, and one between the numbers
            words = [".".join(words[:2]), ".".join(words[2:])]
    try:
        latitude_deg, longitude_deg = map(float, words)
    except ValueError:
        problem = f"expected LAT,LON in degrees, got {text!r}"
        raise InputError(option, problem, "Use coordinates such as 50.8704,9.7080.") from None
    return latitude_deg, longitude_deg


def cost(text: str) -> float:
    """Return the cost of ``--budget``."""
    _check_separators(text, "--budget")
    amount = _parse_quantity(text, {"": 1.0})
    if not 0 < amount < math.inf:
        raise InputError("--budget", f"expected a cost above 0, got {text[:80]}", "Use the total, such as 20000.")
    return amount


def _check_separators(text: str, option: str) -> None:
    """Raise an InputError where a point or comma can separate thousands or decimals, as in 30.000."""
    if choices := ambiguous_number(text):
        raise InputError(option, f"{text} can mean {choices}", f"Write {choices}.")


def width_mm(text: str, least: float, most: float) -> float:
    """Return the width of ``--size`` in millimetres, from 85mm or 8.5cm."""
    width = _parse_quantity(text, {"mm": 1.0, "cm": 10.0, "": 1.0})
    if not least <= width <= most:
        problem = f"expected a width of {least:g} to {most:g} mm, got {text[:80]!r}"
        raise InputError("--size", problem, "Use a width such as 85mm.")
    return width


def point_pair(text: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return both points of ``--align X,Y=LAT,LON``."""
    local, _, where = text.partition("=")
    try:
        x_m, y_m = (float(part) for part in local.split(","))
        latitude_deg, longitude_deg = (float(part) for part in where.split(","))
    except ValueError:
        problem = f"expected X,Y=LAT,LON, got {text[:80]!r}"
        raise InputError("--align", problem, "Use a pair such as 12.5,-3.0=50.8704,9.7080.") from None
    return (x_m, y_m), (latitude_deg, longitude_deg)


def radius_m(text: str) -> float:
    """Return the radius of ``--surroundings`` in metres; inf for "all"."""
    from egvs.scenario.fields import MAX_COORDINATE_M

    if text == "all":
        return math.inf
    _check_separators(text, "--surroundings")
    radius = number_or_nan(text)
    if not 0 < radius <= MAX_COORDINATE_M:
        problem = f"expected a length in metres, or all, got {text[:80]!r}"
        raise InputError("--surroundings", problem, "Use a length such as 300.")
    return radius


def pole_spacing_m(text: str) -> float | None:
    """Return the spacing of ``--poles "every 20m"`` in metres; None for ``existing``."""
    if text == "existing":
        return None
    spacing_m = _parse_quantity(text.removeprefix("every").strip(), {"m": 1.0, "": 1.0})
    if math.isnan(spacing_m):
        problem = f"expected existing, or every and a length in metres, got {text[:80]!r}"
        raise InputError("--poles", problem, "Use a spacing such as every 20m.")
    return spacing_m


_RECORDING_OPTIONS = ("tracks", "like", "pedestrian_tracks", "signals", "track_columns", "track_crs")
"""Parameters of ``egvs new`` that need an extension."""


class PointCommand(TyperCommand):
    """A command that accepts ``--at LAT LON`` in two words, also with decimal commas, for ``--at LAT,LON``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Join a point in two words."""
        words: list[str] = []
        for arg in args:
            previous = words[-1].removesuffix(",") if words else ""
            if words[-2:-1] in (["--at"], ["--around"]) and _is_number(previous) and _is_number(arg):
                words[-1] += f" {arg}"
            else:
                words.append(arg)
        return super().parse_args(ctx, words)


def _is_number(text: str) -> bool:
    return re.fullmatch(r"[+-]?[0-9]+([.,][0-9]+)?", text) is not None


class NewCommand(PointCommand):
    """``egvs new``: accepts ``--poles every 20m`` in two words.

    Its help hides options for recordings where no installed extension reads them.
    """

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help."""
        from egvs.traffic import traffic_sources

        for parameter in self.params:
            if parameter.name in _RECORDING_OPTIONS and not traffic_sources.is_installed():
                parameter.hidden = True  # type: ignore[attr-defined]
        super().format_help(ctx, formatter)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Join a spacing in two words."""
        words: list[str] = []
        for arg in args:
            if words[-2:] == ["--poles", "every"] or words[-1:] == ["--poles=every"]:
                words[-1] += f" {arg}"
            else:
                words.append(arg)
        return super().parse_args(ctx, words)


def length_m(text: str, option: str) -> float:
    """Return metres from 1500, 1500m or 2km."""
    _check_separators(text, option)
    length = _parse_quantity(text, {"m": 1.0, "km": 1000.0, "": 1.0})
    if not 0 < length < math.inf:
        raise InputError(option, f"expected a length above 0, got {text[:80]!r}", "Use a length such as 1500m or 2km.")
    return length


def _parse_quantity(text: str, units: Mapping[str, float]) -> float:
    """Return a plain decimal number times its unit; not a number for anything else."""
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)([A-Za-z]*)", text)
    if match is None or match[2] not in units:
        return math.nan
    return float(match[1]) * units[match[2]]


def command_words(verb: str, path: Path, overrides: Sequence[str] | None, out: Path | None = None) -> list[str]:
    """Return the words of a command."""
    words = ["egvs", verb, str(path)]
    for override in overrides or ():
        words += ["--set", override]
    if out is not None:
        words += ["--out", str(out)]
    return words


def shell_command(verb: str, path: Path, overrides: Sequence[str] | None, out: Path | None = None) -> str:
    """Return a command that can be typed into a shell."""
    return shlex.join(command_words(verb, path, overrides, out))
