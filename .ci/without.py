"""Take extensions away in a copy of the repository, and show that the rest of the program works.

usage: python .ci/without.py NAME... [--each] [--tests MARKS [--leave-out PATH...]]

The copy, in ``build/without``, has the tracked files without ``pipeline/egvs/extensions/NAME``, the tests of NAME and
its entry points. Its wheel is built and unpacked, and comes before the installed package through PYTHONPATH. Then:

1. every module can be imported, and no module names what is gone;
2. ``egvs --help`` lists no command of NAME, and each of them is refused with the name of the extension;
3. ``new``, ``run``, ``place``, ``report``, ``explore``, ``export`` and ``accuracy`` end with 0, and write the same
   artefacts as the complete program (``same.py``);
4. with ``--tests`` instead of 3, those tests of the core pass that have the marks.

With ``--each``, one extension after the other is taken away alone.
"""

from __future__ import annotations

import argparse
import json
import os
import re
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

UNCOMPARED = ("accuracy", "store")
"""What depends on the time that commands take: which settings a study tries, and records of costs."""

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
sys.exit("; ".join(problems) or 0)
"""


def main() -> None:
    """Take the extensions away, and check what is left."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", metavar="NAME", help="folders of pipeline/egvs/extensions")
    parser.add_argument("--each", action="store_true", help="take one after the other away, instead of all together")
    parser.add_argument("--tests", metavar="MARKS", help="run the tests of the core, as pytest -m MARKS")
    parser.add_argument("--leave-out", nargs="*", default=(), metavar="PATH", help="tests of the complete program")
    options = parser.parse_args()

    expected = None
    if options.tests is None:
        expected = ROOT / "build" / "without" / "complete"
        run_commands(Program(ROOT, expected))
    for names in [[name] for name in options.names] if options.each else [options.names]:
        copy = ROOT / "build" / "without" / "-".join(names)
        copy_repository(copy)
        prefixes = remove_extensions(copy, names)
        reduced = ReducedProgram(copy)
        reduced.check_modules(prefixes)
        reduced.check_help(names)
        if expected is None:
            reduced.check_tests(options.tests, options.leave_out)
        else:
            run_commands(reduced)
            compare(expected, reduced.out)
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


class Program:
    """The complete program, as it is installed.

    Parameters
    ----------
    copy
        The repository.
    out
        Folder for what its commands write; emptied.
    """

    def __init__(self, copy: Path, out: Path) -> None:
        self.copy, self.out = copy, out
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        self.environment = {**os.environ, "EGVS_STORE": str(out / "store")}

    def python(self, what: str, *arguments: object, expected: int = 0) -> str:
        """Run Python in the copy, and return what it prints; if it fails, end this program and say what failed."""
        words = [sys.executable, *(str(argument) for argument in arguments)]
        done = subprocess.run(words, cwd=self.copy, env=self.environment, capture_output=True, text=True)
        if done.returncode != expected:
            sys.exit(f"{what} ended with {done.returncode}:\n{done.stdout}{done.stderr}")
        return done.stdout + done.stderr

    def egvs(self, *arguments: object) -> None:
        """Run a command of the program."""
        command = f"egvs {' '.join(str(argument) for argument in arguments)}"
        self.python(command, "-m", "egvs", *arguments)
        report(command)


class ReducedProgram(Program):
    """The program without the extensions: the unpacked wheel of the copy."""

    def __init__(self, copy: Path) -> None:
        super().__init__(copy, copy / "out")
        self.site = copy / "site"
        wheel = ["-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", "wheel", "."]
        subprocess.run([sys.executable, *wheel], cwd=copy, check=True)
        (built,) = (copy / "wheel").glob("*.whl")
        with zipfile.ZipFile(built) as archive:
            archive.extractall(self.site)
        self.environment["PYTHONPATH"] = str(self.site)
        self.environment["NUMBA_CACHE_DIR"] = str(copy.parent / "kernels")  # compiled once, not in each copy
        report("wheel built and unpacked")

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

    def check_help(self, names: Sequence[str]) -> None:
        """Check that the help lists no command of the extensions, and that each is refused with a reason."""
        listed = re.findall(r"^\W*(\w[\w-]*)  ", self.python("egvs --help", "-m", "egvs", "--help"), re.MULTILINE)
        if "run" not in listed:
            sys.exit(f"egvs --help lists no command run: {listed}")
        code = "import json; from egvs.cli.commands import SHIPPED; print(json.dumps(SHIPPED))"
        shipped = json.loads(self.python("reading the commands of extensions", "-c", code))
        for name in names:
            for command in shipped.get(name, ()):
                if command in listed:
                    sys.exit(f"egvs --help lists {command}, a command of {name}")
                printed = self.python(f"egvs {command}", "-m", "egvs", command, expected=2)
                if f"the extension {name}" not in printed:
                    sys.exit(f"egvs {command} does not say that it needs {name}: {printed}")
        report("the help lists no command of what was taken away")

    def check_tests(self, marks: str, left_out: Sequence[str]) -> None:
        """Run the tests of the core that have the marks."""
        environment = {**self.environment, "PYTHONPATH": f"{self.site}{os.pathsep}{self.copy}"}
        words = [sys.executable, "-m", "pytest", "-q", "-m", marks, "-p", "no:cacheprovider"]
        words += [f"--ignore={path}" for path in left_out]
        if subprocess.run(words, cwd=self.copy, env=environment).returncode:
            sys.exit("tests of the core failed without the extensions")
        report("tests")


def run_commands(program: Program) -> None:
    """Run the commands of the core."""
    out = program.out
    program.egvs("new", out / "new", "--from", next((ROOT / "tests").rglob("small.osm")))
    program.egvs("run", *JUNCTION, "--out", out / "run")
    program.egvs("place", *JUNCTION, "--set", "placement.count=2", "--out", out / "run")
    program.egvs("report", *JUNCTION, "--out", out / "run")
    program.egvs("explore", out / "run", "--to", out / "view.html")
    program.egvs("export", out / "run", "--to", "csv")
    program.egvs("accuracy", *JUNCTION, "--out", out / "accuracy", "--budget", "20s")


def compare(expected: Path, out: Path) -> None:
    """Compare what the complete and the reduced program wrote; ends this program if anything differs."""
    for folder in sorted(path.name for path in expected.iterdir() if path.is_dir()):
        if folder in UNCOMPARED:
            continue
        words = [sys.executable, ROOT / ".ci" / "same.py", expected / folder, out / folder]
        done = subprocess.run(words, capture_output=True, text=True)
        if done.returncode:
            sys.exit(f"{folder} differs from that of the complete program:\n{done.stdout}{done.stderr}")
    report("artefacts are those of the complete program")


if __name__ == "__main__":
    main()
