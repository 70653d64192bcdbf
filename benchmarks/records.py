"""Records of benchmark runs: what was measured, on which machine, and with which commit.

``make bench BENCH="--json FILE"`` writes one; ``make bench-history`` compares several (:mod:`benchmarks.history`).
"""

from __future__ import annotations

import os
import platform
import re
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import llvmlite
import numba
import numpy as np
import psutil
from pydantic import BaseModel, ConfigDict, Field, ValidationError

import egvs
from egvs.core.errors import InputError
from egvs.core.files import atomic_write
from egvs.core.reading import read_json

ROOT = Path(__file__).resolve().parent.parent
LIMITS_TABLE = "benchmarks with limits"
"""Title of the table whose rows are name, measured value, limit, and whether the limit is reached."""

_HINT = 'Write the file with: make bench BENCH="--json FILE".'
_QUANTITY = re.compile(r"\s*(-?[\d,]*\.?\d+(?:e[+-]?\d+)?)(?:\s*([^\s\d=]+))?")

Finite = Annotated[float, Field(allow_inf_nan=False)]


class Machine(BaseModel):
    """The computer that ran the benchmarks."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    processor: str
    cores: int
    memory_gb: Finite
    system: str
    python: str
    libraries: dict[str, str]

    @classmethod
    def current(cls) -> Machine:
        """Describe this machine."""
        return cls(
            processor=_processor(Path("/proc/cpuinfo")),
            cores=os.cpu_count() or 1,
            memory_gb=round(psutil.virtual_memory().total / 1e9, 1),
            system=f"{platform.system()} {platform.machine()}",
            python=platform.python_version(),
            libraries={"numpy": np.__version__, "numba": numba.__version__, "llvmlite": llvmlite.__version__},
        )

    @property
    def label(self) -> str:
        """One line that distinguishes machines whose times cannot be compared."""
        return f"{self.processor}, {self.cores} cores, {self.system}, Python {self.python}"


class Result(BaseModel):
    """One row of a table of benchmarks.

    Attributes
    ----------
    table, name
        Title of the table, and the first cell of the row.
    cells
        The further cells: numbers, or text with a unit. Of a row with a limit: what was measured.
    value, unit
        The number that the first cell starts with, and its unit; the value is None when there is no number.
    limit, reached
        What must be reached, and whether it was; None in tables without limits.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    table: str
    name: str
    cells: tuple[Finite | str | None, ...]
    value: Finite | None = None
    unit: str = ""
    limit: str | None = None
    reached: bool | None = None


class Record(BaseModel):
    """Results of one run of the benchmarks.

    Attributes
    ----------
    commit
        The commit of the checkout; None outside a git repository.
    has_local_changes
        Whether tracked files differed from the commit.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1] = 1
    egvs: str
    commit: str | None
    has_local_changes: bool
    time_utc: datetime
    machine: Machine
    results: tuple[Result, ...]

    @classmethod
    def of(cls, results: Iterable[Result]) -> Record:
        """Record results of the checkout on this machine, now."""
        commit, has_local_changes = read_commit(ROOT)
        return cls(
            egvs=egvs.__version__,
            commit=commit,
            has_local_changes=has_local_changes,
            time_utc=datetime.now(UTC).replace(microsecond=0),
            machine=Machine.current(),
            results=tuple(results),
        )

    @classmethod
    def read(cls, path: Path) -> Record:
        """Read a record.

        Raises
        ------
        InputError
            When the file is missing, is not JSON, or is no record of benchmarks.
        """
        content = read_json(path, _HINT)
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(map(str, first["loc"])) or "(top level)"
            message = first["msg"][0].lower() + first["msg"][1:]
            raise InputError(f"{path}: {key}", f"{message}, got {first['input']!r}", _HINT) from None

    def write(self, path: Path) -> None:
        """Write the record as JSON; a folder that is missing is created."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temp_path:
            temp_path.write_text(self.model_dump_json(indent=2) + "\n", encoding="utf-8")


def limit_results(rows: Iterable[tuple[str, str, str, bool]]) -> list[Result]:
    """Return the results of rows with name, measured value, limit, and whether the limit is reached."""
    return [
        _result(LIMITS_TABLE, name, (measured,)).model_copy(
            update={"limit": limit, "reached": reached} if limit else {}
        )
        for name, measured, limit, reached in rows
    ]


def table_results(tables: Mapping[str, Iterable[Sequence[Any]]]) -> list[Result]:
    """Return the results of tables without limits: rows of a name and further cells, by title."""
    return [_result(title, str(row[0]), tuple(map(_cell, row[1:]))) for title, rows in tables.items() for row in rows]


def parse_quantity(text: str) -> tuple[float | None, str]:
    """Return the number that a text starts with, and the unit after it.

    >>> parse_quantity("2.35 s = SUMO + 2.10 s")
    (2.35, 's')
    >>> parse_quantity("1,024 MB")
    (1024.0, 'MB')
    >>> parse_quantity("not measured")
    (None, '')
    """
    match = _QUANTITY.match(text)
    if match is None:
        return None, ""
    return float(match[1].replace(",", "")), match[2] or ""


def read_commit(folder: Path) -> tuple[str | None, bool]:
    """Return the commit of a checkout, and whether tracked files differ from it; None outside a git repository."""
    try:
        commit = _git(folder, "rev-parse", "HEAD")
        return commit, bool(_git(folder, "status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.CalledProcessError):
        return None, False


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def _result(table: str, name: str, cells: tuple[float | str | None, ...]) -> Result:
    first = cells[0] if cells else None
    value, unit = parse_quantity(first) if isinstance(first, str) else (first, "")
    return Result(table=table, name=name.strip(), cells=cells, value=value, unit=unit)


def _cell(value: Any) -> float | str | None:
    """Return a cell as JSON knows it; numbers that are not finite become None."""
    if isinstance(value, (bool, str)):
        return str(value)
    number = float(value)
    return number if np.isfinite(number) else None


def _processor(path: Path) -> str:
    """Return the model of the processor; Linux names it in a file only."""
    if path.is_file():
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()
