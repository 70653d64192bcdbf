"""Change the code in one place at a time, and list the changes that no test notices.

usage: python .ci/mutants.py [--sample N] [--seed S] [--jobs N] [MODULE_OR_PACKAGE...]

A mutant is one changed operator, number, condition or loop, made by Cosmic Ray. Without arguments all mutants of the
formula modules are tried; otherwise those of modules or packages, such as `kernels/occupancy` or `scoring`. Each is
tried on the tests of its module, then on the fast ones of its package, in a process that is forked after the libraries
were imported. A mutant of a kernel is not compiled: that would take longer than the tests. A test that takes more than
ten seconds without a mutant, or fails without compiled kernels, is left out. A mutant is killed if a test fails or
hangs. The others are printed as survivors, but for those in `.ci/equivalent_mutants.txt`, which says why they compute
the same.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import importlib.machinery
import json
import os
import random
import signal
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, ModuleType

import numba
import pytest
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "pipeline" / "egvs"
FORMULA_MODULES = ("scoring/egvs", "kernels/traversal", "kernels/occupancy", "sensors/scanner")
OPERATORS = (
    *(f"ReplaceBinaryOperator_{pair}" for pair in (
        "Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul", "Mod_Mul", "Pow_Mul",
        "RShift_LShift", "LShift_RShift", "BitOr_BitAnd", "BitAnd_BitOr", "BitXor_BitAnd",
    )),
    *(f"ReplaceComparisonOperator_{pair}" for pair in (
        "Eq_NotEq", "NotEq_Eq", "Lt_LtE", "LtE_Lt", "Gt_GtE", "GtE_Gt", "Is_IsNot", "IsNot_Is",
    )),
    "ReplaceUnaryOperator_USub_UAdd", "ReplaceUnaryOperator_Delete_Not",
    "NumberReplacer", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr", "ReplaceOrWithAnd",
    "ReplaceBreakWithContinue", "ReplaceContinueWithBreak", "AddNot", "ZeroIterationForLoop",
)  # fmt: skip
"""One replacement for each operator of Python: the one that is nearest to it."""
PYTEST = ("-q", "-n", "0", "-p", "no:cacheprovider", "--no-header", "--tb=no")
# Python's integers and NumPy's numbers warn where compiled code wraps around or divides by zero as IEEE 754 says.
PYTEST += tuple(f"-Wignore:{start}:RuntimeWarning" for start in ("overflow", "divide by zero", "invalid value"))
LIBRARIES = ("numpy", "scipy", "shapely", "numba", "pyarrow", "trimesh", "pydantic")
USERS = {"sensors/scanner": ("effects", "clouds")}
"""Other packages whose tests say what a module must do."""
FAST, SLOW = "not slow and not nightly", "slow and not nightly"
PASSED = (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)
LONGEST_TEST_S = 10.0
SLOWER = 5.0
LEAST_LIMIT_S = 5.0
"""A test with a mutant may take this and five times its usual time; else it hangs, and the mutant is killed."""


@dataclass(frozen=True)
class Mutant:
    """A module with one change."""

    module: str
    code: str
    line: int
    change: str
    """The changed line before and after, without indentation; it names the mutant whatever its number of line."""

    def __str__(self) -> str:
        return f"{self.module}: {self.change}"


def list_mutants(module: str) -> Iterator[Mutant]:
    """Yield the mutants of a module that may compute something else."""
    source = (SOURCE / f"{module}.py").read_text(encoding="utf-8")
    same = _meaning(source)
    lines = source.splitlines()
    for name in OPERATORS:
        operator = get_operator(f"core/{name}")()
        for occurrence in range(len(source)):
            code = mutate_code(source, operator, occurrence)
            if code is None:
                break
            with suppress(SyntaxError):
                if _meaning(code) == same:
                    continue
                after = code.splitlines()
                line = next(n for n, pair in enumerate(zip(lines, after, strict=False)) if pair[0] != pair[1])
                yield Mutant(module, code, line + 1, f"{lines[line].strip()} -> {after[line].strip()}")


def _meaning(source: str) -> str:
    """Return the syntax tree without annotations and decorators, which say nothing where kernels are not compiled."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.arg | ast.AnnAssign):
            node.annotation = ast.Constant(None)
        elif isinstance(node, ast.FunctionDef):
            node.returns, node.decorator_list = None, []
    return ast.dump(tree)


class _Loader(importlib.machinery.SourceFileLoader):
    """Imports a module with other code."""

    def __init__(self, name: str, path: str, code: str) -> None:
        super().__init__(name, path)
        self._code = code

    def get_code(self, fullname: str) -> CodeType:
        return compile(self._code, self.path, "exec")


class _Finder:
    """Finds a module before Python does."""

    def __init__(self, module: str, code: str) -> None:
        self._name = f"egvs.{module.replace('/', '.')}"
        self._loader = _Loader(self._name, str(SOURCE / f"{module}.py"), code)

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name != self._name:
            return None
        spec = importlib.machinery.ModuleSpec(name, self._loader, origin=self._loader.path)
        spec.has_location = True
        return spec


class _Watch:
    """A plugin of pytest that records how long tests take and which fail, and ends the process when one hangs."""

    def __init__(self, usual_s: Mapping[str, float]) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.failed: set[str] = set()
        self._usual_s = usual_s

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        if nodeid in self._usual_s:
            signal.setitimer(signal.ITIMER_REAL, LEAST_LIMIT_S + SLOWER * self._usual_s[nodeid])

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds[report.nodeid] += report.duration
        if report.failed:
            self.failed.add(report.nodeid)


def fork_tests(
    module: str, options: Sequence[str], usual_s: Mapping[str, float], code: str | None, record: Path | None = None
) -> int:
    """Start tests in a process of its own, with a module's code replaced; return the process.

    Its exit code is 0 if all pass. A test may take some times as long as usual. ``record`` receives the seconds of each
    test, the failed ones, and the imported modules.
    """
    if process := os.fork():
        return process
    os.setsid()
    null = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(null, stream)
    if module.startswith("kernels/"):
        numba.config.DISABLE_JIT = True
    if code is not None:
        sys.meta_path.insert(0, _Finder(module, code))
    watch = _Watch(usual_s)
    ended = int(pytest.main([*PYTEST, *options], plugins=[watch]))
    if record is not None:
        seen = {"seconds": watch.seconds, "failed": sorted(watch.failed), "modules": list(sys.modules)}
        record.write_text(json.dumps(seen), encoding="utf-8")
    os._exit(ended)


def own_and_other_tests(module: str) -> list[list[str]]:
    """Return the files of tests of a module; those of its package and of its users."""
    package, name = module.rsplit("/", 1)
    packages = (package, *USERS.get(module, ()))
    files = [file for each in packages for file in sorted((ROOT / "tests" / each).rglob("test_*.py"))]
    own = [file for file in files if file.stem.startswith(f"test_{name}")]
    parts = own, [file for file in files if file not in own]
    return [[str(file.relative_to(ROOT)) for file in part] for part in parts]


def try_unchanged(module: str, options: Sequence[str], build: Path) -> tuple[list[str], dict[str, float]]:
    """Run tests without a mutant; return the options that leave out what fails or takes long, and seconds by test.

    They are run twice: the first time to learn which libraries they import, which are then imported here.
    """
    record = build / "unchanged.json"
    record.unlink(missing_ok=True)
    for _ in range(2):
        os.waitpid(fork_tests(module, options, {}, None, record), 0)
        seen = json.loads(record.read_text(encoding="utf-8"))
        for name in seen["modules"]:
            if name.split(".")[0] in LIBRARIES:
                with suppress(Exception):  # what cannot be imported alone is imported by the tests
                    importlib.import_module(name)
    long = (name for name, seconds in seen["seconds"].items() if seconds > LONGEST_TEST_S)
    wanted = [*options, *(f"--deselect={name}" for name in {*seen["failed"], *long})]
    same = (SOURCE / f"{module}.py").read_text(encoding="utf-8")
    _, status = os.waitpid(fork_tests(module, [*wanted, "-x"], seen["seconds"], same), 0)
    if (code := os.waitstatus_to_exitcode(status)) not in PASSED:
        raise SystemExit(f"{module}: without a change the tests end with {code}, so they tell nothing of changes")
    return wanted, seen["seconds"]


def survivors(module: str, mutants: Sequence[Mutant], build: Path, jobs: int) -> list[Mutant]:
    """Return the mutants of a module with which all tests pass."""
    alive = list(mutants)
    own, others = own_and_other_tests(module)
    for marks, files in ((FAST, own), (SLOW, own), (FAST, others)):
        if not alive or not files:
            continue
        options, usual_s = try_unchanged(module, ["-m", marks, *files], build)
        left_out = sum(option.startswith("--deselect") for option in options)
        print(f"  {module}, {marks}: {len(alive)} mutants, {len(usual_s)} tests, {left_out} left out", flush=True)
        waiting, alive = alive[::-1], []
        running: dict[int, Mutant] = {}
        while waiting or running:
            while waiting and len(running) < jobs:
                mutant = waiting.pop()
                running[fork_tests(module, [*options, "-x"], usual_s, mutant.code)] = mutant
            process, status = os.wait()
            if os.waitstatus_to_exitcode(status) in PASSED:
                alive.append(running[process])
                print(f"    passes: {running[process].line}: {running[process].change}", flush=True)
            del running[process]
            with suppress(ProcessLookupError):
                os.killpg(process, signal.SIGKILL)
    return alive


def main() -> int:
    """Try the mutants, print the survivors and the shares killed, and return 1 if one is not explained."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="MODULE_OR_PACKAGE", default=FORMULA_MODULES)
    parser.add_argument("--sample", type=int, help="so many mutants, drawn at random; all by default")
    parser.add_argument("--seed", type=int, default=20261128)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    build = ROOT / "build" / "mutants"
    build.mkdir(parents=True, exist_ok=True)
    os.chdir(ROOT)
    explained = (ROOT / ".ci" / "equivalent_mutants.txt").read_text(encoding="utf-8").splitlines()
    unexplained = 0
    for name in options.names:
        package = SOURCE / name
        files = sorted(package.glob("[!_]*.py")) if package.is_dir() else [package.with_suffix(".py")]
        mutants = [m for file in files for m in list_mutants(str(file.relative_to(SOURCE).with_suffix("")))]
        if options.sample is not None:
            mutants = random.Random(options.seed).sample(mutants, options.sample)
        alive: list[Mutant] = []
        for module in dict.fromkeys(mutant.module for mutant in mutants):
            alive += survivors(module, [mutant for mutant in mutants if mutant.module == module], build, options.jobs)
        killed = len(mutants) - len(alive)
        unknown = [mutant for mutant in alive if str(mutant) not in explained]
        unexplained += len(unknown)
        share = f"{killed} of {len(mutants)} mutants killed, {len(alive) - len(unknown)} equivalent"
        print(f"{name}: {share}, {len(unknown)} survive")
        for mutant in unknown:
            print(f"  {mutant.module}.py:{mutant.line}: {mutant.change}", flush=True)
    return 1 if unexplained else 0


if __name__ == "__main__":
    sys.exit(main())
