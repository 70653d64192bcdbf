"""Are the guards on in one of the two runs that are compared, and off in the other?"""

from __future__ import annotations

from pathlib import Path

import pytest

import pipeline
from benchmarks import guards
from pipeline.core.errors import InputError
from pipeline.traffic import sumo
from pipeline.traffic.guarded import copies


@pytest.mark.system
def test_guards_are_off_within_the_block_alone(tmp_path: Path) -> None:
    own = tmp_path / "own"
    own.mkdir()
    (tmp_path / "a.xml").write_text("<additional><include href='b'/></additional>")
    with guards.without_guards():
        assert copies.copy(tmp_path / "a.xml", tmp_path / "b.xml") == []
        with sumo._started(["/bin/sh", "-c", "exit 0"], own, None, None) as process:
            assert process.args[0] == "/bin/sh"
    with pytest.raises(InputError, match="a further file"):
        copies.copy(tmp_path / "a.xml", tmp_path / "b.xml")
    with sumo._started(["/bin/sh", "-c", "exit 0"], own, None, None) as process:
        assert process.args[0] != "/bin/sh"


@pytest.mark.system
def test_both_runs_make_the_same(mini: Path, tmp_path: Path) -> None:
    pipeline.run(pipeline.load(mini), tmp_path / "guarded")
    with guards.without_guards():
        pipeline.run(pipeline.load(mini), tmp_path / "plain")
    for name in ("trajectories.parquet", "scores.parquet"):
        assert (tmp_path / "guarded" / name).read_bytes() == (tmp_path / "plain" / name).read_bytes()
