"""Runs the examples (``>>>``) in the docstrings of the public functions."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

SCENARIOS = Path(__file__).resolve().parents[2] / "scenarios"
SLOW = [pytest.mark.slow, pytest.mark.system]
MODULES = [
    "egvs.core.grid",
    "egvs.runs.run_names",
    "egvs.scenario.loading",
    "egvs.scenario.settings",
    "egvs.scenario.shipped",
    "egvs.scoring.egvs",
    pytest.param("egvs.runs.run", marks=SLOW),
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_return_what_they_show(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scenarios").symlink_to(SCENARIOS)
    monkeypatch.chdir(tmp_path)
    module = importlib.import_module(name)
    examples = [test for test in doctest.DocTestFinder(exclude_empty=True).find(module) if test.examples]
    assert examples
    runner = doctest.DocTestRunner()
    output: list[str] = []
    for example in examples:
        runner.run(example, out=output.append)
    assert runner.failures == 0, "".join(output)
