"""Change the code in one place at a time, and list the changes that no test notices.

usage: python .ci/mutants.py [--sample N] [--seed S] [--jobs N] [--skip-explained] [MODULE_OR_PACKAGE...]

A mutant is one changed operator, number, condition or loop, made by Cosmic Ray. Without arguments all mutants of the
formula modules are tried; otherwise those of modules or packages, such as `kernels/occupancy` or `scoring`. Each is
tried on the tests of its module, then on those of its package, the fast ones first, in a process that is forked once
the tests are collected; there, its code replaces the module's. Only files with a test that calls the changed function
are run, and short tests come first, since most mutants fail one. A mutant of a kernel is not compiled: that would take
longer than the tests. A test that takes more than ten seconds without a mutant, or fails without compiled kernels, is
left out. A mutant is killed if a test fails or hangs. The others survive; they are printed after each group of tests,
and as they are found appended to `build/mutants/passing.txt`.
`.ci/equivalent_mutants.txt` says which mutants compute the same, and why. With `--skip-explained` these are not tried,
nor any other mutant of the module that reads the same.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import itertools
import json
import os
import random
import signal
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from types import FrameType, FunctionType

import numba
import pytest
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "pipeline" / "egvs"
BUILD = ROOT / "build" / "mutants"
UNCHANGED, PASSING = BUILD / "unchanged.json", BUILD / "passing.txt"
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
USERS = {"sensors/scanner": ("effects", "clouds")}
"""Other packages whose tests say what a module must do."""
FAST, SLOW = "not slow and not nightly", "slow and not nightly"
PASSED = (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)
LONGEST_TEST_S = 10.0
SLOWER = 5.0
LEAST_LIMIT_S = 10.0
"""A test with a mutant may take this and five times its usual processor time; else it hangs: the mutant is killed.

It includes fixtures of several tests, which another test made before."""
LONGEST_WAIT_S = 60.0
"""A test may take this and five times its usual processor time by the clock, too: it may wait for another process."""


WHOLE_MODULE = range(sys.maxsize)


@dataclass(frozen=True)
class Mutant:
    """A module with one change."""

    module: str
    code: str
    line: int
    function: range
    """Lines of the function or method with the change; :data:`WHOLE_MODULE` for other code of the module."""

    change: str
    """The changed line before and after, without indentation; it names the mutant whatever its number of line."""

    def __str__(self) -> str:
        return f"{self.module}: {self.change}"


def list_changes(module: str) -> list[tuple[str, str, int]]:
    """Return the module, the operator and the occurrence of each change that may be a mutant."""
    nodes = list(ast_nodes(get_ast(_source(module))))
    changes = []
    for name in OPERATORS:
        operator = get_operator(f"core/{name}")()
        count = sum(len(list(operator.mutation_positions(node))) for node in nodes)
        changes += [(module, name, occurrence) for occurrence in range(count)]
    return changes


def make_mutant(module: str, name: str, occurrence: int) -> Mutant | None:
    """Return the mutant of a change; None if it is no Python, or cannot compute anything else."""
    source = _source(module)
    code = mutate_code(source, get_operator(f"core/{name}")(), occurrence)
    try:
        if code is None or _meaning(code) == _meaning(source):
            return None
    except SyntaxError:
        return None
    pairs = zip(source.splitlines(), code.splitlines(), strict=False)
    line, (before, after) = next((n, pair) for n, pair in enumerate(pairs, start=1) if pair[0] != pair[1])
    function = next((lines for lines in _functions(module) if line in lines), WHOLE_MODULE)
    return Mutant(module, code, line, function, f"{before.strip()} -> {after.strip()}")


@cache
def _functions(module: str) -> list[range]:
    """Return the lines of each function of a module, and of each method of its classes, with their decorators."""
    body = ast.parse(_source(module)).body
    parts = [*body, *(part for each in body if isinstance(each, ast.ClassDef) for part in each.body)]
    functions = [part for part in parts if isinstance(part, ast.FunctionDef)]
    return [range(min(n.lineno for n in [f, *f.decorator_list]), (f.end_lineno or 0) + 1) for f in functions]


@cache
def _source(module: str) -> str:
    return (SOURCE / f"{module}.py").read_text(encoding="utf-8")


@lru_cache(maxsize=2)
def _meaning(source: str) -> str:
    """Return the syntax tree without annotations and decorators, which say nothing where kernels are not compiled."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.arg | ast.AnnAssign):
            node.annotation = ast.Constant(None)
        elif isinstance(node, ast.FunctionDef):
            node.returns, node.decorator_list = None, []
    return ast.dump(tree)


def replace_code(mutant: Mutant) -> None:
    """Give an imported module the code of a mutant.

    A function that is there, wherever it was imported, gets the code of the changed one. For changes elsewhere, the
    module is executed again; what other modules imported from it is replaced.
    """
    changed = importlib.import_module(f"egvs.{mutant.module.replace('/', '.')}")
    before = dict(vars(changed))
    code = compile(mutant.code, str(SOURCE / f"{mutant.module}.py"), "exec")
    if mutant.function != WHOLE_MODULE:
        exec(code, after := {name: before[name] for name in ("__name__", "__file__", "__package__")})
        names = [name for name in before if name in after and before[name] is not after[name]]
        if any([_replace_functions(before[name], after[name], mutant.function) for name in names]):
            return
    exec(code, vars(changed))
    for other in list(sys.modules.values()):
        for name, value in list(getattr(other, "__dict__", {}).items()):
            if name in before and value is before[name] and not name.startswith("__"):
                setattr(other, name, vars(changed)[name])


def _replace_functions(old: object, new: object, lines: range) -> bool:
    """Give a function, or the methods of a class, the code of another one, if it begins in a range of lines.

    Returns whether any did.
    """
    if isinstance(old, type) and isinstance(new, type):
        pairs = [(vars(old).get(name), value) for name, value in vars(new).items() if not isinstance(value, type)]
    else:
        parts = [part for part in ("__func__", "func", "fget", "__wrapped__") if hasattr(old, part)]
        pairs = [(getattr(old, part), getattr(new, part)) for part in parts if hasattr(new, part)]
    replaced = [_replace_functions(*pair, lines) for pair in pairs]
    if isinstance(old, FunctionType) and isinstance(new, FunctionType) and new.__code__.co_firstlineno in lines:
        old.__code__, old.__defaults__, old.__kwdefaults__ = new.__code__, new.__defaults__, new.__kwdefaults__
        return True
    return any(replaced)


class _Tests:
    """A plugin of pytest: how long tests take, which fail, and what each file of tests calls.

    :attr:`calls` has the lines at which functions begin that a file of tests calls, by file of the program.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.failed: set[str] = set()
        self.calls: dict[str, dict[str, set[int]]] = {}
        self._file = ""

    def _trace(self, frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(str(SOURCE)):
            self.calls.setdefault(self._file, {}).setdefault(code.co_filename, set()).add(code.co_firstlineno)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self.seconds[nodeid] = -_processor_s()
        self._file = _file_of(nodeid)
        threading.settrace(self._trace)  # of threads that the test starts
        sys.settrace(self._trace)

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        sys.settrace(None)
        self.seconds[nodeid] += _processor_s()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.add(report.nodeid)


def _file_of(nodeid: str) -> str:
    return nodeid.partition("::")[0]


def _processor_s() -> float:
    """Return the processor time of this process and of those that it waited for."""
    return sum(os.times()[:4])


class _Trials:
    """A plugin of pytest: forks a process for each mutant, which runs tests until one fails or hangs.

    Only files with a test that calls the changed function are run, short tests first.
    """

    def __init__(self, mutants: Sequence[Mutant], unchanged: Unchanged, jobs: int) -> None:
        self._mutants = mutants
        self._seconds = unchanged.seconds
        self._calls = unchanged.calls
        self._jobs = jobs

    def _concerns(self, item: pytest.Item, mutant: Mutant) -> bool:
        called = self._calls.get(_file_of(item.nodeid), {}).get(str(SOURCE / f"{mutant.module}.py"), ())
        return any(line in mutant.function for line in called)

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items.sort(key=lambda item: self._seconds.get(item.nodeid, 0.0))

    @pytest.hookimpl(trylast=True)
    def pytest_collection_finish(self, session: pytest.Session) -> None:
        waiting, running = list(range(len(self._mutants)))[::-1], {}
        while waiting or running:
            if waiting and len(running) < self._jobs:
                number = waiting.pop()
                if not (process := os.fork()):
                    os.setsid()
                    mutant = self._mutants[number]
                    replace_code(mutant)
                    session.items = [item for item in session.items if self._concerns(item, mutant)]
                    return
                running[process] = number
                continue
            process, status = os.wait()
            with suppress(ProcessLookupError):
                os.killpg(process, signal.SIGKILL)
            number = running.pop(process)
            if os.waitstatus_to_exitcode(status) in PASSED:
                with PASSING.open("a", encoding="utf-8") as file:
                    file.write(f"{number} {self._mutants[number]}\n")
        os._exit(0)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        longest_s = SLOWER * self._seconds[nodeid]
        signal.setitimer(signal.ITIMER_PROF, LEAST_LIMIT_S + longest_s)
        signal.setitimer(signal.ITIMER_REAL, LONGEST_WAIT_S + longest_s)


def run_tests(name: str, options: Sequence[str], plugin: _Tests | _Trials) -> int:
    """Run tests of a module or package in a process of its own, and return its exit code; kernels uncompiled."""
    if process := os.fork():
        _, status = os.waitpid(process, 0)
        return os.waitstatus_to_exitcode(status)
    null = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(null, stream)
    if name.split("/")[0] == "kernels":
        numba.config.DISABLE_JIT = True
    ended = int(pytest.main([*PYTEST, *options], plugins=[plugin]))
    if isinstance(plugin, _Tests):
        calls = {file: {k: sorted(v) for k, v in called.items()} for file, called in plugin.calls.items()}
        UNCHANGED.write_text(json.dumps([plugin.seconds, sorted(plugin.failed), calls]), encoding="utf-8")
    os._exit(ended)


def groups_of_tests(name: str) -> list[list[str]]:
    """Return the files of tests of a package; or those of a module, and the others of its package and of its users."""
    package, _, module = name.partition("/")
    packages = (package, *USERS.get(name, ()))
    files = [file for each in packages for file in sorted((ROOT / "tests" / each).rglob("test_*.py"))]
    own = [file for file in files if file.stem.startswith(f"test_{module}")]
    parts = own, [file for file in files if file not in own]
    return [[str(file.relative_to(ROOT)) for file in part] for part in parts if part]


@dataclass(frozen=True)
class Unchanged:
    """Tests without a mutant: options that leave out what fails or takes long, seconds by test, and what they call."""

    options: list[str]
    seconds: dict[str, float]
    calls: dict[str, dict[str, list[int]]]


def try_unchanged(name: str, options: Sequence[str]) -> Unchanged:
    """Run tests without a mutant."""
    UNCHANGED.unlink(missing_ok=True)
    code = run_tests(name, options, _Tests())
    if code not in (*PASSED, pytest.ExitCode.TESTS_FAILED):
        raise SystemExit(f"{name}: without a change the tests end with {code}")
    seconds, failed, calls = json.loads(UNCHANGED.read_text(encoding="utf-8"))
    long = [test for test, each_s in seconds.items() if each_s > LONGEST_TEST_S]
    return Unchanged([*options, *(f"--deselect={test}" for test in {*failed, *long})], seconds, calls)


def survivors(name: str, mutants: Sequence[Mutant], jobs: int) -> list[Mutant]:
    """Return the mutants of a module or package with which all tests pass."""
    alive = list(mutants)
    for files, marks in itertools.product(groups_of_tests(name), (FAST, SLOW)):
        if not alive:
            break
        tests = try_unchanged(name, ["-m", marks, *files])
        left_out = sum(option.startswith("--deselect") for option in tests.options)
        print(f"  {name}, {marks}: {len(alive)} mutants, {len(tests.seconds)} tests, {left_out} left out", flush=True)
        modules = dict.fromkeys(mutant.module for mutant in alive if mutant.function == WHOLE_MODULE)
        controls = [Mutant(module, _source(module), 0, WHOLE_MODULE, "unchanged") for module in modules]
        tried = [*controls, *alive]
        PASSING.write_text("", encoding="utf-8")
        if code := run_tests(name, [*tests.options, "-x"], _Trials(tried, tests, jobs)):
            raise SystemExit(f"{name}: the trials end with {code}, before all mutants were tried")
        passing = {int(line.split(" ")[0]) for line in PASSING.read_text(encoding="utf-8").splitlines()}
        passed = [mutant for number, mutant in enumerate(tried) if number in passing]
        untold = {control.module for control in controls if control not in passed}
        if untold:  # tests keep objects of its former classes
            print(
                f"    fails when its code is executed again, without a change: {', '.join(sorted(untold))}", flush=True
            )
        alive = [m for m in alive if m in passed or (m.function == WHOLE_MODULE and m.module in untold)]
        for mutant in alive:
            print(f"    passes: {mutant.module}:{mutant.line}: {mutant.change}", flush=True)
    return alive


def main() -> int:
    """Try the mutants, print the survivors and the shares killed, and return 1 if one is not explained."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="MODULE_OR_PACKAGE", default=FORMULA_MODULES)
    parser.add_argument("--sample", type=int, help="so many mutants, drawn at random; all by default")
    parser.add_argument("--seed", type=int, default=20261128)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--skip-explained", action="store_true", help="do not try those of equivalent_mutants.txt")
    options = parser.parse_args()
    BUILD.mkdir(parents=True, exist_ok=True)
    os.chdir(ROOT)
    explained = (ROOT / ".ci" / "equivalent_mutants.txt").read_text(encoding="utf-8").splitlines()
    unexplained = 0
    for name in options.names:
        package = SOURCE / name
        files = sorted(package.glob("[!_]*.py")) if package.is_dir() else [package.with_suffix(".py")]
        changes = [c for file in files for c in list_changes(str(file.relative_to(SOURCE).with_suffix("")))]
        if options.sample is not None:
            random.Random(options.seed).shuffle(changes)
        mutants = list(itertools.islice(filter(None, itertools.starmap(make_mutant, changes)), options.sample))
        tried = [mutant for mutant in mutants if not options.skip_explained or str(mutant) not in explained]
        alive = survivors(name, tried, options.jobs)
        unknown = [mutant for mutant in alive if str(mutant) not in explained]
        unexplained += len(unknown)
        equivalent = len(mutants) - len(tried) + len(alive) - len(unknown)
        killed = len(tried) - len(alive)
        share = f"{killed} of {len(mutants)} mutants killed, {equivalent} equivalent"
        print(f"{name}: {share}, {len(unknown)} survive")
        for mutant in unknown:
            print(f"  {mutant.module}.py:{mutant.line}: {mutant.change}", flush=True)
    return 1 if unexplained else 0


if __name__ == "__main__":
    sys.exit(main())
