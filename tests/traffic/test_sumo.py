"""Is what goes wrong with SUMO's programs told with its own words?"""

import os
import sys

import pytest

from egvs.core.errors import MissingBackendError, RunError
from egvs.traffic import sumo


def fake_sumo(folder, monkeypatch, script):
    path = folder / "sumo"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    monkeypatch.setenv("SUMO_BINARY", str(path))


def test_a_missing_system_library_is_named_with_its_packages(tmp_path, monkeypatch):
    says = "sumo: error while loading shared libraries: libX11.so.6: cannot open shared object file: No such file"
    fake_sumo(tmp_path, monkeypatch, f"echo '{says}' >&2; exit 127")
    with pytest.raises(
        MissingBackendError, match=r"libX11\.so\.6 is missing. On Debian, run apt-get install .*libx11-6"
    ):
        sumo.run_program("sumo", ["--version"], tmp_path)


def test_sumo_killed_from_outside_is_told(tmp_path, monkeypatch):
    fake_sumo(tmp_path, monkeypatch, "kill -9 $$")
    with pytest.raises(RunError, match="sumo was killed by signal 9"):
        sumo.run_program("sumo", [], tmp_path)


@pytest.mark.parametrize("signal", [6, 8, 11])
def test_a_crash_is_what_it_was_given(tmp_path, monkeypatch, signal):
    """By damaged networks, some of which SUMO does not survive."""
    fake_sumo(tmp_path, monkeypatch, f"echo {'x' * 1000} >&2; kill -{signal} $$")
    with pytest.raises(sumo.SumoInputError, match=f"sumo crashed with signal {signal}:\n  x{{300}}$"):
        sumo.run_program("sumo", [], tmp_path)


def test_a_binary_that_is_none_is_told(tmp_path, monkeypatch):
    fake_sumo(tmp_path, monkeypatch, "")
    (tmp_path / "sumo").write_bytes(b"\x00not a program")
    with pytest.raises(MissingBackendError, match="sumo cannot be started"):
        sumo.run_program("sumo", [], tmp_path)


def test_finding_sumo_leaves_this_process_its_own_projections(monkeypatch):
    """The wheel's data is of a PROJ that rasterio's refuses."""
    for name in ("PROJ_DATA", "PROJ_LIB", "SUMO_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.delitem(sys.modules, "sumo", raising=False)
    sumo.sumo_binary("sumo")
    assert "PROJ_DATA" not in os.environ and "PROJ_LIB" not in os.environ
    assert sumo.sumo_environment()["PROJ_DATA"].endswith("proj")
    monkeypatch.setenv("PROJ_DATA", "mine")
    sumo.sumo_binary("sumo")
    assert os.environ["PROJ_DATA"] == sumo.sumo_environment()["PROJ_DATA"] == "mine"


def test_another_sumos_version_is_asked(tmp_path, monkeypatch):
    fake_sumo(tmp_path, monkeypatch, "echo 'Eclipse SUMO sumo v1_27_0+0045-abc'")
    sumo.sumo_version.cache_clear()
    try:
        assert sumo.sumo_version() == "1.27.0+0045-abc"
    finally:
        sumo.sumo_version.cache_clear()
