"""Commands whose output README and docs quote, and where pages quote it.

``make docs-figures`` runs the commands of each :class:`Session`, and writes what they print to
``docs/printed/NAME.txt`` and the scores of their runs to ``scores.json`` beside it. A page marks what it quotes by
a comment before a block of code or a paragraph:

    <!-- printed: demo -->

Of a block of code, each part between empty lines and ``[...]`` must stand in the file, or each of its lines; of a
paragraph, each number (signs may be left out), and each *sentence* with a number that is set in italics. Tests compare
the pages with the files, and the files with a new run.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from egvs.artefacts.readers import read_scores
from egvs.core.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PRINTED = DOCS / "printed"
SCORES = PRINTED / "scores.json"
"""Scores of sessions, and those that pictures were drawn from."""


_TIMES = re.compile(r"^(\w[\w ]*?) +(?:[\d.,]+ s|from store|unchanged) +", re.MULTILINE)
_STEPS = re.compile(r"^ +[\d.,]+ s +.*\n", re.MULTILINE)
_CACHED = re.compile(r"(?<=/overpass/)[0-9a-f]{16}(?=\.osm)")
_SIZE = re.compile(r"^(report +)[\d,]+ [kM]B", re.MULTILINE)
_MARK = re.compile(r"^(?: *)<!-- printed: ([\w, -]+) -->\n+", re.MULTILINE)
_FENCE = re.compile(r" *(```+)[^\n]*\n(.*?)\n *\1", re.DOTALL)
_INDENTED = re.compile(r"(?: {4}[^\n]*\n|\n(?= {4}))+")
CODE_BLOCK = re.compile(r"^( *)```[^\n]*\n(.*?)\n\1```|((?:^ {4,}\S[^\n]*\n|\n(?= {4}\S))+)", re.MULTILINE | re.DOTALL)
_LEFT_OUT = re.compile(r"\n\s*\n|^\s*(?:\[?\.\.\.\]?|…)\s*$|\[\.\.\.\]|\.\.\.$", re.MULTILINE)
_SPOKEN = re.compile(r"(?<!\*)\*([^*]*\d[^*]*)\*(?!\*)")
_NUMBER = re.compile(r"(?<![\w.,#/])[+-]?\d[\d,]*(?:\.\d+)?(?: ± \d[\d,]*(?:\.\d+)?)?(?: %)?(?![\w]|\.\d)")


@dataclass(frozen=True)
class Session:
    """Commands that run one after the other in one folder.

    Attributes
    ----------
    name
        Of the file, and in the comments of pages.
    commands
        Command lines that begin with ``egvs``.
    run
        Runs the commands in a folder and returns what each prints; by default, in processes of their own.
    results
        Run folder whose scores are stored, too; pictures of these scores are as old as they are.
    is_quick
        Whether a few seconds are enough.
    """

    name: str
    commands: tuple[str, ...]
    run: Callable[[Session, Path], list[str]] | None = None
    results: str = ""
    is_quick: bool = False

    @property
    def file(self) -> Path:
        """The stored output."""
        return PRINTED / f"{self.name}.txt"

    @property
    def stored(self) -> str:
        """The stored output; empty before the first run."""
        return self.file.read_text(encoding="utf-8") if self.file.exists() else ""

    def printed(self, folder: Path) -> str:
        """Run the commands in a new folder and return what they print, without times and sizes of files."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        (folder / "scenarios").symlink_to(ROOT / "scenarios")
        outputs = (self.run or run_commands)(self, folder)
        parts = [f"$ {command}\n{text.strip()}\n" for command, text in zip(self.commands, outputs, strict=True)]
        return without_times("\n".join(parts).replace(f"{folder}/", ""))

    def scores(self, folder: Path) -> dict[str, float]:
        """Return the share of vehicles found from each site in the run folder, in per cent with one decimal."""
        if not self.results:
            return {}
        rows = read_scores(folder / self.results / "scores.parquet").to_pylist()
        return {row["site"]: round(100.0 * row["expected_detections"], 1) for row in rows}


def run_commands(session: Session, folder: Path) -> list[str]:
    """Run the commands of a session in processes of their own, and return what each prints."""
    return [run_command(command, folder) for command in session.commands]


def run_command(command: str, folder: Path, environment: dict[str, str] | None = None, code: int = 0) -> str:
    """Run one command line in a folder; InputError unless it ends with the exit code."""
    done = subprocess.run(
        [sys.executable, "-m", "egvs", *shlex.split(command)[1:]], cwd=folder, env=os.environ | (environment or {}),
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, encoding="utf-8", check=False,
    )  # fmt: skip
    if done.returncode != code:
        raise InputError(command, f"expected exit code {code}, got {done.returncode}:\n{done.stdout}", "See above.")
    return done.stdout


def without_times(text: str) -> str:
    """Remove the seconds of stages, steps in the order of time, the size of the report and names in the cache.

    Examples
    --------
    >>> without_times("check           3.6 s   8 sites checked\\nscan       from store   8 sites scanned")
    'check   8 sites checked\\nscan   8 sites scanned'
    """
    text = _CACHED.sub("...", _STEPS.sub("", text))
    text = _SIZE.sub(r"\1...", _TIMES.sub(r"\1   ", text))
    return "\n".join(line.rstrip() for line in text.split("\n"))


@dataclass(frozen=True)
class Quote:
    """A block of code or a paragraph of a page that quotes what is printed.

    Attributes
    ----------
    page, line
        Where it begins.
    sessions
        Names of the sessions that print it.
    text
        Without the fence.
    is_code
        Whether it is a block of code.
    """

    page: Path
    line: int
    sessions: tuple[str, ...]
    text: str
    is_code: bool

    def stale_parts(self, printed: str) -> list[str]:
        """Return the parts of the text that are not in what the sessions print."""
        if self.is_code:
            whole = one_line(printed)
            parts = [part for part in _LEFT_OUT.split(without_times(self.text)) if one_line(part) not in whole]
            return [line for part in parts for line in map(one_line, part.splitlines()) if line not in whole]
        whole = one_line(printed)
        known = {sign for number in numbers_of(printed) for sign in (number, number.lstrip("+-"))}
        spoken = [one_line(part) for part in _SPOKEN.findall(self.text)]
        return [part for part in spoken if part not in whole] + [
            number for number in numbers_of(self.text) if number not in known
        ]


def one_line(text: str) -> str:
    """Return the text without line breaks and emphasis, each run of blanks as one."""
    return " ".join(text.replace("*", "").split())


def numbers_of(text: str) -> list[str]:
    """Return the numbers of a text, with their errors and per cent, without those of links.

    Examples
    --------
    >>> numbers_of("finds 74 ± 6 % of 1,040 vehicles ([k02@3m](a.md#part-2))")
    ['74 ± 6 %', '1,040']
    """
    return _NUMBER.findall(one_line(re.sub(r"\]\([^)]*\)|`[^`]*`", " ", text)))


def quotes_of(page: Path) -> Iterator[Quote]:
    """Yield what a page quotes.

    Raises
    ------
    InputError
        If nothing follows a comment.
    """
    text = page.read_text(encoding="utf-8")
    for mark in _MARK.finditer(text):
        rest = text[mark.end() :]
        line = text.count("\n", 0, mark.end()) + 1
        names = tuple(name.strip() for name in mark[1].split(","))
        if fence := _FENCE.match(rest):
            yield Quote(page, line, names, fence[2], is_code=True)
        elif indented := _INDENTED.match(rest):
            yield Quote(page, line, names, indented[0], is_code=True)
        elif paragraph := rest.partition("\n\n")[0].strip():
            yield Quote(page, line, names, paragraph, is_code=False)
        else:
            raise InputError(f"{page}: line {line}", "expected a block or a paragraph after the comment", "Move it.")


def block_of(page: Path, start: str) -> str:
    """Return the block of code of a page that begins with a text, without its indentation.

    Raises
    ------
    InputError
        Unless there is one.
    """
    text = page.read_text(encoding="utf-8")
    for match in CODE_BLOCK.finditer(text):
        block = textwrap.dedent(match[2] or match[3]).strip("\n")
        if block.startswith(start):
            return f"{block}\n"
    raise InputError(page, f"expected a block of code that begins with {start!r}", "Change benchmarks.docs_figures.")


def pages() -> list[Path]:
    """Return README and the pages of the docs."""
    return [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
