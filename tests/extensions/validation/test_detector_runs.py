"""Detector runs: independent of processes, cached, without processes left behind."""

import multiprocessing
import os
import select
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from egvs import load
from egvs.core.errors import InputError, RunError
from egvs.extensions.validation import held_out_traffic
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME
from egvs.extensions.validation.detector_runs import DetectionListener, SiteDetectionTask, run_detectors
from tests.extensions.validation.stub_detectors import FailingDetector, MiddleDetector

FRAMES = 10


@pytest.fixture
def record(mini, tmp_path):
    return held_out_traffic.prepare_held_out_traffic(load(mini), tmp_path / "unseen", FRAMES)


class RecordingListener(DetectionListener):
    """Records the events that it receives."""

    def __init__(self):
        self.missing, self.done = None, []

    def begins(self, missing, frames, processes):
        self.missing = missing

    def site_done(self, site, detectors, cost):
        self.done.append((site, list(detectors)))


def _plain(results):
    """Findings that can be compared."""
    points = {site: [entry.tolist() for entry in by[POINT_COUNTS_NAME].points] for site, by in results.items()}
    others = {
        (site, name): [(entry.boxes.tolist(), entry.scores.tolist()) for entry in what.frames]
        for site, by in results.items()
        for name, what in by.items()
        if name != POINT_COUNTS_NAME
    }
    return points, others


@pytest.mark.slow
@pytest.mark.system
def test_results_do_not_depend_on_processes_or_order(record, monkeypatch):
    monkeypatch.setenv("EGVS_STORE", "")  # no cached results
    task, sites = SiteDetectionTask(record, {"middle": MiddleDetector()}), record.scene.sites
    one, two = (_plain(run_detectors(sites, task, jobs=jobs)) for jobs in (1, 2))
    assert one == two
    assert _plain(run_detectors(sites[::-1], task, jobs=1)) == one  # nor does the order
    assert sum(map(sum, one[0]["pole_a"])) > 20 and len(one[1]["pole_a", "middle"]) == FRAMES
    assert multiprocessing.active_children() == []


def test_caches_results(record, monkeypatch):
    task, sites, listener = (
        SiteDetectionTask(record, {"middle": MiddleDetector()}),
        record.scene.sites,
        RecordingListener(),
    )
    first = run_detectors(sites, task, jobs=1, listener=listener)
    assert listener.done == [("pole_a", [POINT_COUNTS_NAME, "middle"]), ("pole_b", [POINT_COUNTS_NAME, "middle"])]
    with monkeypatch.context() as patch:
        patch.setattr(SiteDetectionTask, "at", lambda *_: pytest.fail("looked again"))
        again = run_detectors(sites, task, jobs=1, listener=(second_listener := RecordingListener()))
    assert _plain(again) == _plain(first) and not any(second_listener.missing.values())
    more = SiteDetectionTask(record, {"middle": MiddleDetector(), "other": MiddleDetector(5.0)})
    run_detectors(sites, more, jobs=1, listener=(listener := RecordingListener()))
    assert listener.done == [("pole_a", ["other"]), ("pole_b", ["other"])]


def test_keys_depend_on_all_inputs(mini, tmp_path, record):
    site = record.scene.sites[0]

    def key(detector=None, at=site, what=POINT_COUNTS_NAME, of=record):
        return SiteDetectionTask(of, {"middle": detector or MiddleDetector()}).key(at, what)

    def of(name, *sets):
        return held_out_traffic.prepare_held_out_traffic(load(mini, sets), tmp_path / name, FRAMES)

    points, boxes = key(), key(what="middle")
    assert points != boxes
    assert key(MiddleDetector(5.0), what="middle") != boxes and key(MiddleDetector(5.0)) == points
    assert key(at=replace(site, name="pole_z")) != points  # random numbers depend on the name
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
        ("refuse", InputError, r"^model.onnx: no model\. Use a model$"),
        ("die", RunError, r"^a worker process was killed, .* Use fewer --jobs"),
        ("interrupt", KeyboardInterrupt, None),
    ],
)
def test_failure_of_one_process_ends_all(record, tmp_path, what, error, message):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    (tmp_path / "pole_b").write_text(what)
    try:
        with pytest.raises(error, match=message):
            run_detectors(
                record.scene.sites, SiteDetectionTask(record, {"odd": FailingDetector(folder=tmp_path)}), jobs=2
            )
    finally:
        signal.signal(signal.SIGINT, before)
    assert multiprocessing.active_children() == []


def test_interrupted_run_resumes_from_cached_results(record, tmp_path):
    task = SiteDetectionTask(record, {"odd": FailingDetector(folder=tmp_path)})
    (tmp_path / "pole_b").write_text("refuse")
    with pytest.raises(InputError):
        run_detectors(record.scene.sites, task, jobs=1)
    (tmp_path / "pole_b").unlink()
    run_detectors(record.scene.sites, task, jobs=1, listener=(listener := RecordingListener()))
    assert listener.done == [("pole_b", [POINT_COUNTS_NAME, "odd"])]


ORPHANS = """
import sys
from pathlib import Path
from egvs import load
from egvs.extensions.validation import held_out_traffic
from egvs.extensions.validation.detector_runs import SiteDetectionTask, run_detectors
from tests.extensions.validation.stub_detectors import FailingDetector

if __name__ == "__main__":
    mini, folder = map(Path, sys.argv[1:])
    record = held_out_traffic.prepare_held_out_traffic(load(mini), folder / "unseen", 10)
    run_detectors(record.scene.sites, SiteDetectionTask(record, {"odd": FailingDetector(folder=folder)}), jobs=2)
"""


@pytest.mark.slow
@pytest.mark.system
def test_no_worker_outlives_killed_main_process(mini, tmp_path):
    os.mkfifo(tmp_path / "alive")
    (tmp_path / "pole_b").write_text("orphan")
    (tmp_path / "orphans.py").write_text(ORPHANS)
    root = Path(__file__).resolve().parents[3]
    command = [sys.executable, tmp_path / "orphans.py", mini, tmp_path]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    killed = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
    with (tmp_path / "alive").open("rb", buffering=0) as alive:
        assert alive.read(1) == b"x"
        assert killed.wait() == -signal.SIGKILL
        assert select.select([alive], [], [], 60)[0], "a process is still running"
        assert alive.read(1) == b""  # its end was closed with it


@pytest.mark.slow
@pytest.mark.system
def test_script_without_main_guard_is_refused(mini, tmp_path):
    """Its worker processes would run the script again, and the main process would wait for them."""
    (tmp_path / "unguarded.py").write_text(ORPHANS.replace('__name__ == "__main__"', "True"))
    root = Path(__file__).resolve().parents[3]
    run = subprocess.run(
        [sys.executable, tmp_path / "unguarded.py", mini, tmp_path],
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "RunError" in run.stderr.splitlines()[-1] and 'below `if __name__ == "__main__":`' in run.stderr
