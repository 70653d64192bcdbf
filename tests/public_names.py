"""Checks of the public names of a package: each works as the first import of a process, and has a docstring."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import pytest

import egvs
from tests.conftest import write_mini

ROOT = Path(__file__).resolve().parent.parent


def run_python(code: str, folder: Path = ROOT, stdin: str = "") -> str:
    """Run ``code`` in a new process in ``folder`` and return what it prints."""
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, input=stdin, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of a small scenario that keeps what its sites see."""
    folder = tmp_path_factory.mktemp("offered")
    write_mini(folder / "mini")
    scenario = egvs.load(folder / "mini", ["score.keep_visibility='all'"])
    egvs.run(scenario, folder / "run", jobs=1)
    return folder


ONE_EACH = """
import json, os, sys, tempfile
import numba, numpy, pyarrow.parquet, pydantic, scipy.special, trimesh, urllib.request, xml.sax.saxutils

class Model(pydantic.BaseModel):  # imports modules that pydantic loads lazily
    number: int

assert not {"egvs", "pandas", "matplotlib", "pyproj"} & set(sys.modules)
results = {}
for name, code in json.loads(sys.stdin.read()).items():
    with tempfile.TemporaryFile("w+") as output:
        child = os.fork()
        if child == 0:
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
            exec(compile(code, name, "exec"), {"__name__": "__main__"})
            sys.stdout.flush()
            os._exit(0)
        failed = os.waitpid(child, 0)[1]
        output.seek(0)
        results[name] = failed, output.read()
print(json.dumps(results))
"""
"""Runs each code in a process of its own, in which nothing of this program was imported. Imported before are
libraries that cost most of the time."""


def check(package: ModuleType, uses: Mapping[str, str], folder: Path) -> None:
    """Import each name of a package and use it, in a folder with a scenario and its run.

    Parameters
    ----------
    package
        The package.
    uses
        Public name to an expression that must be true, with statements before it, separated by "; ".
    folder
        From :func:`run_folder`.
    """
    codes = {}
    for name, text in sorted(uses.items()):
        *before, use = text.split("; ")
        lines = [f"from {package.__name__} import {name}", *before, f"assert {use}"]
        codes[name] = "\n".join(
            [*lines, f"import inspect\nprint(inspect.isclass({name}))\nprint(inspect.getdoc({name}))"]
        )
    for name, (failed, output) in json.loads(run_python(ONE_EACH, folder, json.dumps(codes))).items():
        assert not failed, (name, output)
        kind, doc = output.split("\n", 1)
        assert doc.strip() not in ("", "None"), name
        assert kind == str(name[0].isupper()), name
