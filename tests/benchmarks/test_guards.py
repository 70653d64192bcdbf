"""Is what guards cost added up, and do they guard while it is?"""

from __future__ import annotations

from pathlib import Path

import pytest
from benchmarks import guards

from egvs.core.errors import InputError
from egvs.traffic import sumo, user_files


@pytest.mark.system
def test_guards_work_while_their_time_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guards, "launcher_s", lambda: 2.0)
    (tmp_path / "a.xml").write_text("<additional><include href='b'/></additional>")
    with guards.accounted() as spent_s:
        with pytest.raises(InputError, match="a further file"):
            user_files.copy_checked(tmp_path / "a.xml", tmp_path / "b.xml")
        for _ in range(3):
            with sumo._start_program(["/bin/sh", "-c", "exit 0"], tmp_path, None, None) as process:
                assert "sandbox.py" in str(process.args)
    assert spent_s[guards.START] == 6.0
    assert spent_s["files read before they are copied"] > 0.0
    with sumo._start_program(["/bin/sh", "-c", "exit 0"], tmp_path, None, None):
        assert spent_s[guards.START] == 6.0
