"""Take extensions away in a copy of the repository, and show that the rest of the program works.

usage: python .ci/without.py NAME... [--tests [PATH...]]

The copy, in ``build/without``, has the tracked files without ``pipeline/egvs/extensions/NAME``, the tests of NAME and
its entry points. Its wheel is built and unpacked, and comes before the installed package through PYTHONPATH. Then:

1. every module can be imported, and no module names what is gone;
2. ``egvs --help``, ``new``, ``run``, ``place``, ``report``, ``explore``, ``export`` and ``accuracy`` end with 0;
3. with ``--tests``, the tests that are left pass, except slow ones.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
import zipfile
from collections.abc import Sequence
from pathlib import Path

import tomlkit

ROOT = Path(__file__).resolve().parent.parent
BEGIN_S = time.monotonic()
JUNCTION = ("scenarios/roundabout", "--set", "traffic.frames=200")

IMPORT_ALL = """
import importlib, importlib.metadata, pkgutil, sys
import egvs

prefixes, problems = tuple(sys.argv[1:]), []
for module in pkgutil.walk_packages(egvs.__path__, "egvs."):
    if module.name.endswith("__main__") or ".training" in module.name:  # PyTorch is an extra
        continue
    try:
        importlib.import_module(module.name)
    except Exception as error:
        problems.append(f"{module.name}: {error!r}")
for entry in importlib.metadata.distribution("egvs").entry_points:
    if entry.value.startswith(prefixes):
        problems.append(f"entry point {entry}")
print(egvs.__file__)
sys.exit("; ".join(problems))
"""


def main() -> None:
    """Take the extensions away, and check what is left."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", metavar="NAME", help="folders of pipeline/egvs/extensions")
    parser.add_argument("--tests", nargs="*", metavar="PATH", help="run the tests that are left, or those in PATH")
    options = parser.parse_args()

    copy = ROOT / "build" / "without" / "-".join(options.names)
    copy_repository(copy)
    prefixes = remove_extensions(copy, options.names)
    reduced = ReducedProgram(copy)
    reduced.check_modules(prefixes)
    reduced.check_commands()
    if options.tests is not None:
        reduced.check_tests(options.tests or ["tests"])
    report("done")


def report(text: str) -> None:
    """Print a line with the time since the start."""
    print(f"{time.monotonic() - BEGIN_S:6.1f} s  {text}", flush=True)


def copy_repository(copy: Path) -> None:
    """Copy all files that git tracks."""
    shutil.rmtree(copy, ignore_errors=True)
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name)


def remove_extensions(copy: Path, names: Sequence[str]) -> tuple[str, ...]:
    """Delete the folders, the tests and the entry points of extensions, and return the names of their packages."""
    for name in names:
        shutil.rmtree(copy / "pipeline" / "egvs" / "extensions" / name)
        shutil.rmtree(copy / "tests" / "extensions" / name)
    prefixes = tuple(f"egvs.extensions.{name}" for name in names)

    path = copy / "pyproject.toml"
    project = tomlkit.parse(path.read_text(encoding="utf-8"))
    groups = project["project"]["entry-points"]
    dropped = [
        (group, key) for group, entries in groups.items() for key in entries if entries[key].startswith(prefixes)
    ]
    for group, key in dropped:
        del groups[group][key]
    path.write_text(tomlkit.dumps(project), encoding="utf-8")
    report(f"took away {', '.join(prefixes)}, and {len(dropped)} entry points")
    return prefixes


class ReducedProgram:
    """The program without the extensions: the unpacked wheel of the copy."""

    def __init__(self, copy: Path) -> None:
        self.copy, self.site = copy, copy / "site"
        wheel = ["-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", "wheel", "."]
        subprocess.run([sys.executable, *wheel], cwd=copy, check=True)
        (built,) = (copy / "wheel").glob("*.whl")
        with zipfile.ZipFile(built) as archive:
            archive.extractall(self.site)
        self.environment = {**os.environ, "PYTHONPATH": str(self.site), "EGVS_STORE": str(copy / "store")}
        report("wheel built and unpacked")

    def python(self, what: str, *arguments: object) -> str:
        """Run Python in the copy, and return what it prints; if it fails, end this program and say what failed."""
        words = [sys.executable, *(str(argument) for argument in arguments)]
        done = subprocess.run(words, cwd=self.copy, env=self.environment, capture_output=True, text=True)
        if done.returncode:
            sys.exit(f"{what} ended with {done.returncode}:\n{done.stdout}{done.stderr}")
        return done.stdout

    def egvs(self, *arguments: object) -> None:
        """Run a command of the program."""
        command = f"egvs {' '.join(str(argument) for argument in arguments)}"
        self.python(command, "-m", "egvs", *arguments)
        report(command)

    def check_modules(self, prefixes: Sequence[str]) -> None:
        """Import every module, and look for names of what is gone in their texts."""
        if str(self.site) not in (printed := self.python("importing all modules", "-c", IMPORT_ALL, *prefixes)):
            sys.exit(f"the installed package was imported, not the reduced one: {printed}")
        naming = [
            str(path.relative_to(self.site))
            for path in sorted((self.site / "egvs").rglob("*.py"))
            if any(prefix in path.read_text(encoding="utf-8") for prefix in prefixes)
        ]
        if naming:
            sys.exit(f"these modules name what was taken away: {', '.join(naming)}")
        report("all modules can be imported; none names what was taken away")

    def check_commands(self) -> None:
        """Run the commands of the core."""
        out = self.copy / "out"
        self.egvs("--help")
        self.egvs("new", out / "new", "--from", next((self.copy / "tests").rglob("small.osm")))
        self.egvs("run", *JUNCTION, "--out", out / "run")
        self.egvs("place", *JUNCTION, "--set", "placement.count=2", "--out", out / "run")
        self.egvs("report", *JUNCTION, "--out", out / "run")
        self.egvs("explore", out / "run", "--to", out / "view.html")
        self.egvs("export", out / "run", "--to", "csv")
        self.egvs("accuracy", *JUNCTION, "--out", out / "accuracy", "--budget", "20s")

    def check_tests(self, paths: Sequence[str]) -> None:
        """Run the tests that are left, except slow ones."""
        environment = {**self.environment, "PYTHONPATH": f"{self.site}{os.pathsep}{self.copy}"}
        words = [sys.executable, "-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider", *paths]
        subprocess.run(words, cwd=self.copy, env=environment, check=True)
        report("tests")


if __name__ == "__main__":
    main()
