"""Another process compiles kernels in the first run after installing, and what stages prepare is what they call."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numba
import pytest

from egvs.kernels import jit
from egvs.runs import kernel_compiler, stage_registry
from egvs.runs.kernel_compiler import KernelCompiler
from tests.processes import python

COUNT_SIGNATURES = """
import gc, json, sys
import egvs
from egvs.kernels import jit
from egvs.runs import stage_registry

def signatures():
    kernels = [item for item in gc.get_objects() if isinstance(item, jit.Kernel) and item._made is not None]
    return sorted([kernel.__qualname__, str(signature)] for kernel in kernels for signature in kernel._made.signatures)

folder, out = sys.argv[1:]
scenario = egvs.load(folder)
egvs.run(scenario, out, only=("check", "statics", "scan", "traffic"))
counts = [signatures()]
for stage in ("tpog", "score"):
    for prepare in stage_registry.stage(stage).prepare:
        prepare()
counts.append(signatures())
egvs.run(scenario, out, only=("check", "statics", "scan", "traffic", "tpog", "score"))
counts.append(signatures())
print(json.dumps(counts))
"""


@pytest.mark.slow
def test_prepared_kernels_are_those_that_stages_call(mini: Path, tmp_path: Path) -> None:
    done = python(COUNT_SIGNATURES, mini, tmp_path / "out")
    assert done.returncode == 0, done.stderr
    before, prepared, after = json.loads(done.stdout.splitlines()[-1])
    assert len(prepared) > len(before)
    assert after == prepared


class Started:
    """What a compiler did, in order; its process reads from a pipe until that is closed or it is killed."""

    def __init__(self, patch: pytest.MonkeyPatch, *, compiled: bool) -> None:
        self.events: list[str] = []
        self.processes: list[subprocess.Popen[bytes]] = []
        stage = SimpleNamespace(prepare=(lambda: self.events.append("first"), self._prepare_last))
        patch.setattr(stage_registry, "stage", lambda _: stage)
        patch.setattr(jit, "has_compiled_kernels", lambda: compiled)
        patch.setattr(kernel_compiler, "thread_count", lambda _: 2)
        patch.setattr(kernel_compiler, "_start", self._start)

    def _start(self) -> subprocess.Popen[bytes]:
        self.events.append("start")
        process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, stderr=subprocess.DEVNULL)
        self.processes.append(process)
        return process

    def _prepare_last(self) -> None:
        self.events.append("last")
        stdin = self.processes[0].stdin
        assert stdin is not None
        stdin.close()


def test_work_is_shared_and_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    started = Started(monkeypatch, compiled=False)
    with KernelCompiler() as compiler:
        compiler.before("check", ["scan", "score", "report"])
        compiler.before("scan", ["score", "report"])
        assert started.events == ["start"]
        assert started.processes[0].poll() is None
        compiler.before("score", ["report"])
        assert started.processes[0].returncode is not None
    assert started.events == ["start", "last"]


@pytest.mark.parametrize(("compiled", "next_stages"), [(True, ["score"]), (False, ["report"])])
def test_no_process_where_kernels_are_compiled_or_not_needed(
    monkeypatch: pytest.MonkeyPatch, compiled: bool, next_stages: list[str]
) -> None:
    started = Started(monkeypatch, compiled=compiled)
    with KernelCompiler() as compiler:
        compiler.before("check", next_stages)
        compiler.before("score", [])
    assert started.events == []


def test_process_ends_with_an_interrupted_run(monkeypatch: pytest.MonkeyPatch) -> None:
    started = Started(monkeypatch, compiled=False)
    with pytest.raises(KeyboardInterrupt), KernelCompiler() as compiler:
        compiler.before("check", ["score"])
        raise KeyboardInterrupt
    process = started.processes[0]
    assert process.returncode is not None
    assert process.stdin is not None
    process.stdin.close()


def test_cache_with_a_file_has_compiled_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "_has_cache_folder", lambda: True)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    assert not jit.has_compiled_kernels()
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels" / "a.kernel").touch()
    assert jit.has_compiled_kernels()
    monkeypatch.setattr(jit, "_has_cache_folder", lambda: False)
    assert jit.has_compiled_kernels()


@pytest.mark.slow
def test_module_compiles_kernels_in_its_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without compiling: what the functions call is plain Python then."""
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    process = kernel_compiler._start()
    assert process.wait() == 0
