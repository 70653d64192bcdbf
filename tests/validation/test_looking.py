"""Looking from sites: cores do not matter, what the store has is not looked at again, nothing is left behind."""

import multiprocessing
import os
import select
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline import load
from pipeline.core.errors import InputError, RunError
from pipeline.validation import unseen_record
from pipeline.validation.looking import Look, LookListener, look_from
from pipeline.validation.site_findings import POINTS
from tests.validation.detecting import Middle, Odd

FRAMES = 10


@pytest.fixture
def record(mini, tmp_path):
    return unseen_record.prepare(load(mini), tmp_path / "unseen", FRAMES)


class Heard(LookListener):
    """Remembers what it was told."""

    def __init__(self):
        self.missing, self.done = None, []

    def begins(self, missing, frames, processes):
        self.missing = missing

    def looked(self, site, detectors, cost):
        self.done.append((site, list(detectors)))


def _plain(found):
    """Findings that can be compared."""
    points = {site: [its.tolist() for its in by[POINTS].points] for site, by in found.items()}
    others = {
        (site, name): [(its.boxes.tolist(), its.scores.tolist()) for its in what.frames]
        for site, by in found.items()
        for name, what in by.items()
        if name != POINTS
    }
    return points, others


@pytest.mark.slow
@pytest.mark.system
def test_the_same_is_found_whatever_the_processes(record, monkeypatch):
    monkeypatch.setenv("EGVS_STORE", "")  # so that all is looked at both times
    look, sites = Look(record, {"middle": Middle()}), record.scene.sites
    one, two = (_plain(look_from(sites, look, jobs=jobs)) for jobs in (1, 2))
    assert one == two
    assert _plain(look_from(sites[::-1], look, jobs=1)) == one  # nor does the order
    assert sum(map(sum, one[0]["pole_a"])) > 20 and len(one[1]["pole_a", "middle"]) == FRAMES
    assert multiprocessing.active_children() == []


def test_what_was_found_is_kept(record, monkeypatch):
    look, sites, heard = Look(record, {"middle": Middle()}), record.scene.sites, Heard()
    first = look_from(sites, look, jobs=1, listener=heard)
    assert heard.done == [("pole_a", [POINTS, "middle"]), ("pole_b", [POINTS, "middle"])]
    with monkeypatch.context() as patch:
        patch.setattr(Look, "at", lambda *_: pytest.fail("looked again"))
        again = look_from(sites, look, jobs=1, listener=(kept := Heard()))
    assert _plain(again) == _plain(first) and not any(kept.missing.values())
    more = Look(record, {"middle": Middle(), "other": Middle(5.0)})
    look_from(sites, more, jobs=1, listener=(heard := Heard()))
    assert heard.done == [("pole_a", ["other"]), ("pole_b", ["other"])]


def test_keys_change_with_all_that_findings_depend_on(mini, tmp_path, record):
    site = record.scene.sites[0]

    def key(detector=None, at=site, what=POINTS, of=record):
        return Look(of, {"middle": detector or Middle()}).key(at, what)

    def of(name, *sets):
        return unseen_record.prepare(load(mini, sets), tmp_path / name, FRAMES)

    points, boxes = key(), key(what="middle")
    assert points != boxes
    assert key(Middle(5.0), what="middle") != boxes and key(Middle(5.0)) == points
    assert key(at=replace(site, name="pole_z")) != points  # random numbers are the site's own
    assert key(at=replace(site, pose=replace(site.pose, z_m=4.0))) != points
    assert key(at=replace(site, pose=replace(site.pose, yaw_deg=1.0))) != points
    assert key(of=replace(record, numbers=record.numbers[:5])) != points
    for name, change in {
        "sensor": "sensors.small.range_sigma_m=0.1",
        "beams": "sensors.small.azimuth_step_deg=2.0",
        "effect": "effects.rain.rate_mm_h=20",
        "seed": "seed=8",
        "roi": "roi.size_m=[40, 10, 5]",
        "statics": "statics.footprints=[]",
    }.items():
        other = of(name, change)
        assert key(at=other.scene.sites[0], of=other) != points, change
    same = of("same", "score.gamma=2.0", "roi.voxel_m=1.0", "tpog.blocks=2")
    assert key(at=same.scene.sites[0], of=same) == points


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize(
    ("what", "error", "message"),
    [
        ("refuse", InputError, r"^model.onnx: no model; a model$"),
        ("die", RunError, r"^a process that looked from a site was ended from outside; .* fewer --jobs need less"),
        ("interrupt", KeyboardInterrupt, None),
    ],
)
def test_what_ends_one_process_ends_all(record, tmp_path, what, error, message):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    (tmp_path / "pole_b").write_text(what)
    try:
        with pytest.raises(error, match=message):
            look_from(record.scene.sites, Look(record, {"odd": Odd(folder=tmp_path)}), jobs=2)
    finally:
        signal.signal(signal.SIGINT, before)
    assert multiprocessing.active_children() == []


def test_an_interrupted_look_goes_on_from_what_was_found(record, tmp_path):
    look = Look(record, {"odd": Odd(folder=tmp_path)})
    (tmp_path / "pole_b").write_text("refuse")
    with pytest.raises(InputError):
        look_from(record.scene.sites, look, jobs=1)
    (tmp_path / "pole_b").unlink()
    look_from(record.scene.sites, look, jobs=1, listener=(heard := Heard()))
    assert heard.done == [("pole_b", [POINTS, "odd"])]


ORPHANS = """
import sys
from pathlib import Path
from pipeline import load
from pipeline.validation import unseen_record
from pipeline.validation.looking import Look, look_from
from tests.validation.detecting import Odd

if __name__ == "__main__":
    mini, folder = map(Path, sys.argv[1:])
    record = unseen_record.prepare(load(mini), folder / "unseen", 10)
    look_from(record.scene.sites, Look(record, {"odd": Odd(folder=folder)}), jobs=2)
"""


@pytest.mark.slow
@pytest.mark.system
def test_no_process_outlives_one_that_was_killed(mini, tmp_path):
    os.mkfifo(tmp_path / "alive")
    (tmp_path / "pole_b").write_text("orphan")
    (tmp_path / "orphans.py").write_text(ORPHANS)
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, tmp_path / "orphans.py", mini, tmp_path]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    killed = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
    with (tmp_path / "alive").open("rb", buffering=0) as alive:
        assert alive.read(1) == b"x"
        assert killed.wait() == -signal.SIGKILL
        assert select.select([alive], [], [], 60)[0], "a process is still at work"
        assert alive.read(1) == b""  # its end was closed with it
