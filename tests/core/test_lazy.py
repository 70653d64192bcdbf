"""Packages that import their public names on first use: every name exists, and importing the package loads nothing."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import egvs

FOLDER = Path(egvs.__file__).parent
PACKAGES = sorted(
    ".".join(("egvs", *path.parent.relative_to(FOLDER).parts))
    for path in FOLDER.rglob("__init__.py")
    if "lazy_exports(" in path.read_text(encoding="utf-8")
)
HEAVY = ["numpy", "numba", "pyarrow", "pydantic", "shapely", "trimesh", "matplotlib", "embreex", "scipy", "onnxruntime"]


@pytest.mark.parametrize("name", PACKAGES)
def test_every_public_name_exists(name: str) -> None:
    package = importlib.import_module(name)
    assert dir(package) == sorted(set(package.__all__))
    assert len(set(package.__all__)) == len(package.__all__)
    for public in package.__all__:
        assert getattr(package, public) is not None


@pytest.mark.parametrize("name", PACKAGES)
def test_rejects_unknown_name(name: str) -> None:
    with pytest.raises(AttributeError, match=f"module '{name}' has no attribute 'nothing'"):
        _ = importlib.import_module(name).nothing


@pytest.mark.system
def test_importing_packages_loads_nothing_heavy() -> None:
    code = f"import sys, {', '.join(PACKAGES)}; print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"
