"""Is a file told that SUMO did not write to its end?"""

import pytest

from egvs.core.errors import RunError
from egvs.stages import traffic
from egvs.traffic import sumo
from tests.stages import run_stage
from tests.traffic.guarded.lanes import configured
from tests.traffic.helpers import SMALL, scenario


@pytest.mark.parametrize("blocks", [0, 8])
def test_a_full_disk_is_told(town, tmp_path, monkeypatch, blocks):
    """A limit on the size of files stands in for a full disk: SUMO ends with 0 on both."""
    limited = tmp_path / "sumo-limited"
    limited.write_text(f"#!/bin/sh\ntrap '' XFSZ\nulimit -f {blocks}\n{sumo.sumo_binary('sumo')} \"$@\"\nexit 0\n")
    limited.chmod(0o755)
    monkeypatch.setenv("SUMO_BINARY", str(limited))
    with pytest.raises(RunError, match=r"fcd\.csv: SUMO wrote an incomplete file. Is the disk full\? \([\d,]+ MB"):
        run_stage(traffic, scenario(town, network="net.xml", **SMALL), tmp_path / "out")


def cut_to_rows(path):
    text = path.read_text().splitlines(keepends=True)
    path.write_text("".join(text[: len(text) // 2]))


def cut_amid_a_row(path):
    path.write_text(path.read_text()[:-9])


def empty(path):
    path.write_bytes(b"")


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("fcd.csv", cut_to_rows), ("fcd.csv", cut_amid_a_row), ("fcd.csv", empty), ("statistics.xml", cut_to_rows),
        ("statistics.xml", empty), ("collisions.xml", cut_amid_a_row),
    ],
)  # fmt: skip
def test_a_file_that_is_cut_is_told(place, tmp_path, monkeypatch, name, damage):
    damaged(monkeypatch, name, damage)
    with pytest.raises(RunError, match=f"{name}: SUMO wrote an incomplete file"):
        run_stage(traffic, configured(place), tmp_path / "out")


@pytest.mark.parametrize(
    ("hold", "message"),
    [
        ("at_most", r"fcd\.csv: SUMO wrote an incomplete file"),
        ("exactly", r"expected 12 vehicles in every frame, got them in 1\d\d of 240 frames"),
    ],
)
def test_frames_that_are_missing_at_the_end_are_told(town, tmp_path, monkeypatch, hold, message):
    damaged(monkeypatch, "fcd.csv", cut_to_rows)
    with pytest.raises(RunError, match=message):
        run_stage(traffic, scenario(town, network="net.xml", hold=hold, **SMALL), tmp_path / "out")


def damaged(monkeypatch, name, damage):
    """Have a file of SUMO's damaged as soon as SUMO has ended."""
    run = sumo.run_program

    def cut(program, arguments, folder, *more):
        printed = run(program, arguments, folder, *more)
        damage(folder / name)
        return printed

    monkeypatch.setattr(sumo, "run_program", cut)


def test_a_network_that_netconvert_did_not_write_to_its_end_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(sumo, "run_program", lambda *_: (tmp_path / "a.net.xml").write_text("<net>\n <edge"))
    with pytest.raises(RunError, match=r"a\.net\.xml: SUMO wrote an incomplete file. Is the disk full\?"):
        sumo.run_netconvert([], tmp_path, "a.net.xml")
    monkeypatch.setattr(sumo, "run_program", lambda *_: (tmp_path / "a.net.xml").write_text("<net>\n</net>\n"))
    sumo.run_netconvert([], tmp_path, "a.net.xml")
