"""Compiled kernels are cached between processes, and compiled again when a kernel that they call has changed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import egvs

pytestmark = pytest.mark.system

PACKAGE = Path(egvs.__file__).parent
INNER = "from egvs.kernels.jit import njit\n\n\n@njit()\ndef inner(x):\n    return x + {}\n"
OUTER = (
    "from egvs.kernels.jit import njit\nfrom egvs.kernels.inner import inner\n\n\n"
    "@njit()\ndef outer(x):\n    return inner(x)\n"
)
CALL = """
from egvs.kernels.outer import outer
print(outer(1), "compiled" if outer.stats.cache_misses else "cached")
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package of two kernels, one of which calls the other."""
    kernels = tmp_path / "egvs" / "kernels"
    kernels.mkdir(parents=True)
    (tmp_path / "egvs" / "__init__.py").write_text("")
    shutil.copytree(PACKAGE / "core", tmp_path / "egvs" / "core", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(PACKAGE / "kernels" / "__init__.py", kernels)
    for name in ("jit.py", "kernel_cache.py"):
        shutil.copy(PACKAGE / "kernels" / name, kernels)
    (kernels / "inner.py").write_text(INNER.format(1))
    (kernels / "outer.py").write_text(OUTER)
    return tmp_path


def call(package: Path, code: str = CALL, **environment: str) -> str:
    clean = {key: value for key, value in os.environ.items() if key not in ("NUMBA_CACHE_DIR", "PYTHONPATH")}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=package, env=clean | environment, check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


def cache_file_count(folder: Path) -> int:
    return len(list(folder.glob("numba-*")))


@pytest.mark.slow
def test_change_of_called_kernel_recompiles(package: Path) -> None:
    assert call(package) == "2 compiled"
    assert call(package) == "2 cached"
    (package / "egvs" / "kernels" / "inner.py").write_text(INNER.format(2))
    assert call(package) == "3 compiled"
    assert call(package) == "3 cached"
    folder = package / "egvs" / "kernels" / "__pycache__"
    assert cache_file_count(folder) == 2
    for number in range(3):
        (folder / f"numba-{number:012}").mkdir()
        os.utime(folder / f"numba-{number:012}", (number, number))
    (package / "egvs" / "kernels" / "inner.py").write_text(INNER.format(3))
    assert call(package) == "4 compiled"
    assert cache_file_count(folder) == 3  # the present one, and two that a program may still use
    assert not list(folder.glob("numba-000*")), "those that were used longest ago went"


@pytest.mark.slow
def test_uses_folder_set_by_user(package: Path, tmp_path: Path) -> None:
    assert call(package, NUMBA_CACHE_DIR=str(tmp_path / "mine")) == "2 compiled"
    assert call(package, NUMBA_CACHE_DIR=str(tmp_path / "mine")) == "2 cached"
    assert cache_file_count(tmp_path / "mine") == 1
    assert cache_file_count(package / "egvs" / "kernels" / "__pycache__") == 0


@pytest.mark.slow
def test_uses_user_cache_where_package_is_read_only(package: Path, tmp_path: Path) -> None:
    (package / "egvs" / "kernels" / "__pycache__").write_text("a file where the folder would be")
    home = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    assert call(package, **home) == "2 compiled"
    assert call(package, **home) == "2 cached"
    assert cache_file_count(tmp_path / "cache" / "egvs") == 1


SUMS = """
import numpy as np
from egvs.kernels.jit import njit

@njit()
def sums(x):
    result = np.zeros(2)
    result[0] = np.sum(x)
    result[1] = x.min()
    return result
"""
CALL_SUMS = """
import sys
import numpy as np
from egvs.kernels.sums import sums
print(sums(np.array([1.0, 4.0])).tolist(), "compiled" if sums.stats.cache_misses else "cached")
print("numba.typed.dictimpl" in sys.modules)  # serves to compile dictionaries
"""
CALLS_SUMS = """
from egvs.kernels.jit import njit
from egvs.kernels.sums import sums

@njit()
def doubled(x):
    return 2.0 * sums(x)
"""
CALL_DOUBLED = CALL_SUMS.replace("sums", "doubled")


@pytest.mark.slow
def test_cached_kernel_is_loaded_without_numbas_implementations(package: Path) -> None:
    (package / "egvs" / "kernels" / "sums.py").write_text(SUMS)
    (package / "egvs" / "kernels" / "doubled.py").write_text(CALLS_SUMS)
    assert call(package, CALL_SUMS).splitlines() == ["[5.0, 1.0] compiled", "True"]
    assert call(package, CALL_SUMS).splitlines() == ["[5.0, 1.0] cached", "False"]
    # A kernel that calls a loaded one is compiled, cached and loaded in turn.
    assert call(package, CALL_SUMS + CALL_DOUBLED).splitlines()[2] == "[10.0, 2.0] compiled"
    assert call(package, CALL_DOUBLED).splitlines() == ["[10.0, 2.0] cached", "False"]


DAMAGES = """
import hashlib, importlib, pathlib, pickle
from egvs.kernels import outer
assert outer.outer(1) == 2
cached, = pathlib.Path("egvs/kernels/__pycache__").rglob("outer.outer-*.kernel")
whole, other = cached.read_bytes(), pickle.dumps((0, 1))
for data in (
    whole, whole[:len(whole) // 2], whole[:32], whole[:1], b"", whole[:-9] + bytes([whole[-9] ^ 4]) + whole[-8:],
    hashlib.sha256(other).digest() + other, whole,
):
    cached.write_bytes(data)
    importlib.reload(outer)
    assert outer.outer(1) == 2
    print("compiled" if outer.outer.stats.cache_misses else "cached")
"""


@pytest.mark.slow
def test_recompiles_damaged_cache_file(package: Path) -> None:
    assert call(package, DAMAGES).split() == ["cached", *["compiled"] * 6, "cached"]


@pytest.mark.slow
def test_uses_temporary_folder_where_nothing_is_writable(package: Path, tmp_path: Path) -> None:
    (package / "egvs" / "kernels" / "__pycache__").write_text("a file where the folder would be")
    (tmp_path / "cache").write_text("and here")
    (tmp_path / "tmp").mkdir()
    none = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    temporary = none | {"TMPDIR": str(tmp_path / "tmp")}
    assert call(package, **temporary) == "2 compiled"
    assert call(package, **temporary) == "2 cached"
    (own,) = (tmp_path / "tmp").iterdir()
    assert (own.name, cache_file_count(own), own.stat().st_mode & 0o777) == (f"egvs-{os.geteuid()}", 1, 0o700)
    own.chmod(0o777)  # anybody could lay a kernel there
    assert call(package, **temporary) == "2 compiled"
    assert call(package, **none | {"NUMBA_CACHE_DIR": str(tmp_path / "cache" / "x"), **temporary}) == "2 compiled"
