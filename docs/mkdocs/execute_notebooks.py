"""Execute the notebooks of ``docs/notebooks`` in place: ``make notebooks``.

Each notebook runs in a temporary copy of its folder, with an empty cache of results; nothing else is written in the
checkout. Compiled kernels are kept as always: the first notebook after a change of them takes a minute longer.

Outputs are saved without what differs from run to run: times, ids, and the metadata of editors. A cell that raises,
writes to standard error, or prints a path of this machine is an error.

    python docs/mkdocs/execute_notebooks.py               all notebooks
    python docs/mkdocs/execute_notebooks.py NAME...       some of them; names without .ipynb
    python docs/mkdocs/execute_notebooks.py --to FOLDER   write the results there instead
    python docs/mkdocs/execute_notebooks.py --store STORE use this cache, which another run may have filled
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError, CellTimeoutError, DeadKernelError

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
KERNEL = {"display_name": "Python 3", "language": "python", "name": "python3"}
KERNEL_ARGUMENTS = [
    "--InlineBackend.figure_formats={'retina'}",
    "--HistoryManager.enabled=False",
    "--IPKernelApp.log_level=40",
]
MAX_CELL_S = 900
KEPT_CELL_KEYS = ("alt", "tags")
"""Metadata of cells that are kept: the text alternative of a figure, and tags."""

_ABSOLUTE_PATH = re.compile(
    r"""(?:^|[\s"'(=,])(/(?:home|root|tmp|var|usr|opt|work|Users|private|mnt)/|[A-Z]:\\|(?:\.\./){3})"""
)


class NotebookError(Exception):
    """A notebook that cannot be executed, or whose outputs cannot be saved."""


def execute(path: Path, store: Path | None = None) -> nbformat.NotebookNode:
    """Return a notebook with the outputs of a fresh run, normalised.

    Parameters
    ----------
    path
        The notebook.
    store
        Folder of cached results and compiled code; an empty one by default.

    Raises
    ------
    NotebookError
        When a cell fails, takes too long, writes to standard error, or prints a path of this machine.
    """
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory(prefix="egvs-notebook-") as scratch:
        folder = Path(scratch) / "notebooks"
        shutil.copytree(path.parent / "data", folder / "data")
        client = NotebookClient(
            notebook, timeout=MAX_CELL_S, kernel_name="python3", resources={"metadata": {"path": str(folder)}},
            extra_arguments=KERNEL_ARGUMENTS,
        )  # fmt: skip
        try:
            client.execute(env={**os.environ, "EGVS_STORE": str(store or Path(scratch) / "store")})
        except (CellExecutionError, CellTimeoutError, DeadKernelError) as error:
            raise NotebookError(f"{path.name}: {error}") from None
    normalise(notebook)
    problems = list(find_problems(notebook))
    if problems:
        raise NotebookError("\n".join(f"{path.name}: {problem}" for problem in problems))
    return notebook


def normalise(notebook: nbformat.NotebookNode) -> None:
    """Remove what differs from run to run or between editors; join the lines that a cell prints."""
    notebook.metadata = nbformat.from_dict({"kernelspec": KERNEL, "language_info": {"name": "python"}})
    notebook.nbformat, notebook.nbformat_minor = 4, 5
    for number, cell in enumerate(notebook.cells, 1):
        cell.id = f"cell-{number:02}"
        cell.metadata = nbformat.from_dict({key: cell.metadata[key] for key in KEPT_CELL_KEYS if key in cell.metadata})
        if cell.cell_type != "code":
            continue
        outputs: list[Any] = []
        for output in cell.outputs:
            if (
                outputs
                and output.output_type == outputs[-1].output_type == "stream"
                and output.name == outputs[-1].name
            ):
                outputs[-1].text += output.text
                continue
            if "data" in output and "image/png" in output.data:
                output.data.pop("text/plain", None)  # <Figure size ...>
            outputs.append(output)
        cell.outputs = outputs


def find_problems(notebook: nbformat.NotebookNode) -> Iterator[str]:
    """Yield what must not be published: errors, standard error, paths of this machine."""
    for number, cell in enumerate(notebook.cells, 1):
        for output in cell.get("outputs", ()):
            if output.output_type == "error":
                yield f"cell {number} raised {output.ename}: {output.evalue}"
            elif output.output_type == "stream" and output.name == "stderr":
                yield f"cell {number} writes to standard error: {output.text.strip()}"
            for text in texts_of(output):
                if match := _ABSOLUTE_PATH.search(text):
                    line = text[max(0, match.start() - 20) : match.end() + 40]
                    yield f"cell {number} prints a path of this machine: {line!r}"


def texts_of(output: nbformat.NotebookNode) -> Iterator[str]:
    """Yield the texts of an output: what is printed, and its representations that are not images."""
    if output.output_type == "stream":
        yield output.text
    for kind, value in sorted(output.get("data", {}).items()):
        if kind.startswith("text/"):
            yield value


def processor_s() -> float:
    """Return the processor seconds of all ended child processes; 0 on Windows."""
    times = os.times()
    return times.children_user + times.children_system


def main() -> int:
    """Execute, print the seconds of each notebook, and return the exit code."""
    parser = argparse.ArgumentParser(description="Execute the notebooks of docs/notebooks in place.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="notebooks, without .ipynb; all by default")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help="write the results there instead")
    parser.add_argument("--store", type=Path, metavar="STORE", help="folder of cached results; an empty one by default")
    arguments = parser.parse_args()
    known = {path.stem: path for path in sorted(NOTEBOOKS.glob("*.ipynb"))}
    if unknown := [name for name in arguments.names if name not in known]:
        parser.error(f"NAME: expected one of {', '.join(known)}, got {unknown[0]}")
    failed = False
    for name in arguments.names or known:
        began_s, used_s = time.monotonic(), processor_s()
        try:
            notebook = execute(known[name], arguments.store and arguments.store.resolve())
        except NotebookError as error:
            print(error, file=sys.stderr)
            failed = True
            continue
        target = (arguments.to or NOTEBOOKS) / f"{name}.ipynb"
        target.parent.mkdir(parents=True, exist_ok=True)
        nbformat.write(notebook, target)
        seconds = f"{time.monotonic() - began_s:5.0f} s, of the processors {processor_s() - used_s:.0f} s"
        print(f"{name:<20} {seconds}; {target.stat().st_size / 1000:.0f} kB", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
