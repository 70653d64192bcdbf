"""Costs of checks are added up, and the checks still work."""

from __future__ import annotations

from pathlib import Path

import pytest
from benchmarks import file_checks

from egvs.core.errors import InputError
from egvs.traffic import sumo, user_files


@pytest.mark.system
def test_checks_work_while_they_are_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_checks, "launcher_s", lambda: 2.0)
    (tmp_path / "a.xml").write_text("<additional><include href='b'/></additional>")
    with file_checks.measure_checks() as spent_s:
        with pytest.raises(InputError, match="read another file"):
            user_files.copy_checked(tmp_path / "a.xml", tmp_path / "b.xml")
        for _ in range(3):
            with sumo._start_program(
                ["/bin/sh", "-c", "exit 0"], tmp_path, sumo.Allowance.for_input(tmp_path), None, None
            ) as process:
                assert "sandbox.py" in str(process.args)
    assert spent_s[file_checks.START] == 6.0
    assert spent_s["files read before they are copied"] > 0.0
    with sumo._start_program(["/bin/sh", "-c", "exit 0"], tmp_path, sumo.Allowance.for_input(tmp_path), None, None):
        assert spent_s[file_checks.START] == 6.0
