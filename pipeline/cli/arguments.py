"""Options that several verbs share, and values that are more than a number or a path."""

from __future__ import annotations

import math
import re
import shlex
from pathlib import Path
from typing import Annotated

import typer

from pipeline.core.errors import InputError

ScenarioPath = Annotated[Path, typer.Argument(metavar="SCENARIO", help="A folder with a scenario.toml, or the file.")]
Run = Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a finished run.")]
Out = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="The run's folder; runs/<scenario name> by default.")
]
Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override one value, e.g. traffic.frames=500.")
]
Jobs = Annotated[
    int | None, typer.Option("--jobs", min=1, help="Threads; one a core by default. Results do not depend on it.")
]
Top = Annotated[
    int | None, typer.Option("--top", metavar="N", min=1, help="Print the best N sites only; all by default.")
]
Audit = Annotated[bool, typer.Option("--audit", help="Check every beam's chords, and print the worst case.")]


def duration_s(text: str, option: str = "--budget") -> float:
    """Seconds from 90s, 10m or 1.5h."""
    units = {"s": 1.0, "m": 60.0, "h": 3600.0, "": 1.0}
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)([smh]?)", text)
    seconds = float(match[1]) * units[match[2]] if match else 0.0
    if not 0 < seconds < float("inf"):
        raise InputError(option, repr(text), "a time above 0 with one unit, for example 90s, 10m or 1.5h")
    return seconds


def heights_m(text: str) -> tuple[float, float]:
    """``--heights``: LOW,HIGH in metres."""
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?),([0-9]+(?:\.[0-9]+)?)", text)
    low, high = (float(match[1]), float(match[2])) if match else (0.0, 0.0)
    if not 0 < low <= high <= 100:
        raise InputError("--heights", repr(text), "LOW,HIGH in metres, for example 2,7")
    return low, high


def model_file(path: Path) -> Path:
    """``--out`` of ``egvs train``: a name that ends in .onnx."""
    if path.suffix != ".onnx":
        raise InputError("--out", repr(str(path)), "a file that ends in .onnx, for example model.onnx")
    return path


def size_bytes(text: str) -> float:
    """``--max``: bytes from 500M or 2G."""
    units = {"": 1.0, "K": 1e3, "M": 1e6, "G": 1e9, "T": 1e12}
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)([KMGT]?)B?", text)
    if match is None:
        raise InputError("--max", repr(text), "a size, for example 500M or 2G")
    return float(match[1]) * units[match[2]]


def host_and_port(text: str) -> tuple[str, int]:
    """``--traci``: HOST:PORT."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise InputError("--traci", repr(text), "HOST:PORT, for example localhost:8813")
    return host, int(port)


def latitude_and_longitude(text: str, option: str = "--at") -> tuple[float, float]:
    """``--at``, ``--around``: LAT,LON in degrees."""
    try:
        lat, lon = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(option, repr(text), "LAT,LON in degrees, for example 50.8704,9.7080") from None
    return lat, lon


def width_mm(text: str, least: float, most: float) -> float:
    """``--size``: millimetres on paper, from 85mm or 8.5cm."""
    units = {"mm": 1.0, "cm": 10.0, "": 1.0}
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)(mm|cm)?", text)
    value = float(match[1]) * units[match[2] or ""] if match else math.nan
    if not least <= value <= most:
        raise InputError("--size", repr(text)[:80], f"a width of {least:g} to {most:g} mm, for example 85mm")
    return value


def radius_m(text: str) -> float | None:
    """``--surroundings``: metres, or None for all."""
    from pipeline.scenario.types import FARTHEST_M

    if text == "all":
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value <= FARTHEST_M:
        raise InputError("--surroundings", repr(text)[:80], "metres, for example 300, or all")
    return value


def length_m(text: str, option: str) -> float:
    """Metres from 1500, 1500m or 2km."""
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)(m|km)?", text)
    value = float(match[1]) * (1000.0 if match[2] == "km" else 1.0) if match else math.nan
    if not 0 < value < math.inf:
        raise InputError(option, repr(text)[:80], "a length above 0, for example 1500m or 2km")
    return value


def command(verb: str, scenario: Path, set_: list[str] | None, out: Path | None = None) -> str:
    """A command that the user can type."""
    words = ["egvs", verb, str(scenario), *(word for one in set_ or () for word in ("--set", one))]
    return shlex.join([*words, "--out", str(out)] if out is not None else words)
