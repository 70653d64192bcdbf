"""Runs detectors on all frames of all sites, on all cores, and caches their results.

A *viewpoint* is a site, or a group of sites whose point clouds are fused
(:mod:`egvs.extensions.validation.plan_validation`). Each viewpoint is one piece of work: its sweeps are simulated once
for all detectors whose results are not cached. Random numbers belong to a site and a frame, so the results depend
neither on the number of processes nor on the order.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from egvs.artefacts import parquet
from egvs.clouds import simulation as cloud_simulation
from egvs.clouds.simulation import CloudSimulator, sweep_rng
from egvs.clouds.sweeps import Detections, Sweep
from egvs.core import files
from egvs.core.errors import RunError
from egvs.core.main_guard import check_main_guard
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.resource_usage import ResourceUsage, measure_usage
from egvs.core.threads import thread_count
from egvs.effects import registry
from egvs.effects.base import Effect
from egvs.extensions.validation import detector_results
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME, DetectedBoxes, DetectorResult, PointCounts
from egvs.extensions.validation.detectors.base import Detector
from egvs.extensions.validation.held_out_traffic import HeldOutTraffic
from egvs.runs import stage_keys, stage_registry
from egvs.runs.store import Store
from egvs.sensors.scanner import Scanner
from egvs.sensors.sites import Site
from egvs.stages.scene_dependencies import sensor_digests


class Viewpoint(Protocol):
    """A site, or several sites at once."""

    @property
    def name(self) -> str:
        """A name that is unique in a run."""
        raise NotImplementedError


SweepDetector = Callable[[Sequence[Sweep]], Detections]
"""Detects the vehicles in the sweeps of one instant."""

ViewpointT = TypeVar("ViewpointT", bound=Viewpoint)
ViewpointT_contra = TypeVar("ViewpointT_contra", bound=Viewpoint, contravariant=True)
DetectorT = TypeVar("DetectorT", bound=Detector)


class DetectionTask(Protocol[ViewpointT_contra]):
    """Some detectors on recorded traffic, for viewpoints of one kind. Can be sent to another process."""

    @property
    def record(self) -> HeldOutTraffic:
        """The traffic."""
        raise NotImplementedError

    @property
    def names(self) -> list[str]:
        """Names of the detectors, points on vehicles first."""
        raise NotImplementedError

    def at(self, viewpoint: ViewpointT_contra, names: Sequence[str]) -> dict[str, DetectorResult]:
        """Return the results of some of the detectors at a viewpoint, by name."""
        raise NotImplementedError

    def key(self, viewpoint: ViewpointT_contra, name: str) -> str:
        """Return a hash of everything that a detector's result at a viewpoint depends on."""
        raise NotImplementedError


class DetectionListener:
    """Receives the progress of a detector run. This base class ignores it."""

    def begins(self, missing: Mapping[str, Sequence[str]], frames: int, processes: int) -> None:
        """Receive, once at the start, the detectors whose results are not cached, by viewpoint."""

    def site_done(self, site: str, detectors: Sequence[str], cost: ResourceUsage) -> None:
        """Receive the name of a viewpoint whose results are complete, for these detectors."""


@dataclass(frozen=True)
class DetectionTaskBase(Generic[DetectorT]):
    """What detection from one site and from several fused sites have in common.

    Attributes
    ----------
    record
        The traffic.
    detectors
        Detectors by name. Points on vehicles are always counted as well.
    """

    record: HeldOutTraffic
    detectors: Mapping[str, DetectorT]

    @property
    def names(self) -> list[str]:
        """Names of the detectors, points on vehicles first."""
        return [POINT_COUNTS_NAME, *self.detectors]

    @cached_property
    def scanner(self) -> Scanner:
        """Scanner of full sweeps."""
        return Scanner(self.record.scene, full_sweep=True)

    def simulators(self, sites: Sequence[Site]) -> list[CloudSimulator]:
        """Return the point cloud simulator of each site."""
        scene = self.record.scene
        meshes = cloud_simulation.vehicle_meshes(scene.scenario)
        return [CloudSimulator.of_site(scene, site, self.scanner, meshes) for site in sites]

    def detect(
        self, simulators: Sequence[CloudSimulator], detectors: Mapping[str, SweepDetector], *, with_points: bool
    ) -> dict[str, DetectorResult]:
        """Return what each detector finds in the sweeps of all frames.

        Parameters
        ----------
        simulators
            One per sensor.
        detectors
            Detectors by name; each receives the sweeps of one instant, in the order of ``simulators``.
        with_points
            Whether the points on vehicles are counted as well, summed over all sensors.
        """
        roi = self.record.scene.roi
        seed = self.record.scenario.seed
        points = []
        detections: dict[str, list[Detections]] = {name: [] for name in detectors}

        for frame in self.record.read():
            frame_sweeps, points_on_box = [], []
            for simulator in simulators:
                labelled = simulator.sweep(frame, sweep_rng(seed, simulator.view.site, frame.number))
                frame_sweeps.append(labelled.sweep)
                points_on_box.append(labelled.points_on(len(frame.boxes)))
            points.append(np.array(points_on_box)[:, frame.target_rows(roi)].sum(axis=0))
            for name, detect in detectors.items():
                detections[name].append(detector_results.detections_in_roi(detect(frame_sweeps), roi))

        results: dict[str, DetectorResult] = {name: DetectedBoxes(tuple(boxes)) for name, boxes in detections.items()}
        if with_points:
            results[POINT_COUNTS_NAME] = PointCounts(tuple(points))
        return results


@dataclass(frozen=True)
class SiteDetectionTask(DetectionTaskBase[Detector]):
    """Detection from single sites."""

    def at(self, site: Site, names: Sequence[str]) -> dict[str, DetectorResult]:
        """Return the results of some of the detectors at a site, by name."""
        (simulator,) = self.simulators([site])
        detectors = {}
        for name in names:
            if name != POINT_COUNTS_NAME:
                detectors[name] = _first_sweep_detector(self.detectors[name], simulator, self.record)
        return self.detect([simulator], detectors, with_points=POINT_COUNTS_NAME in names)

    def settings(self, site: Site, name: str) -> dict[str, Any]:
        """Return everything that a detector's result at a site depends on, besides the program."""
        scene, scenario = self.record.scene, self.record.scenario
        detector = self.detectors.get(name)
        custom_sensor = scenario.sensors.get(site.sensor)
        return {
            "detector": [name, detector.settings if detector else {}],
            "record": [self.record.keys, self.record.numbers.tolist(), scenario.seed],
            "site": [site.name, site.pose.position_m, site.pose.angles_deg],
            "sensor": [
                site.sensor,
                custom_sensor.model_dump(mode="json") if custom_sensor else None,
                sensor_digests(scenario, [site]),
            ],
            "bodies": cloud_simulation.hash_body_files(scenario),
            "effects": registry.effect_settings(scene.acting(Effect)),
            "roi": [scene.roi.origin_m, scene.roi.size_m],
        }

    def key(self, site: Site, name: str) -> str:
        """Return a hash of everything that a detector's result at a site depends on."""
        modules = [__name__, *registry.effect_modules(self.record.scene.acting(Effect))]
        if detector := self.detectors.get(name):
            modules.append(type(detector).__module__)
        sources = [stage_keys.source_digest(module) for module in modules]
        libraries: frozenset[str] = frozenset()
        libraries = libraries.union(*(source.libraries for source in sources))
        program = {
            "program": [source.digest for source in sources],
            "libraries": stage_keys.library_versions(libraries),
            "schema": parquet.SCHEMA_VERSION,
        }
        return files.hash_json(self.settings(site, name) | program)


def _first_sweep_detector(detector: Detector, simulator: CloudSimulator, record: HeldOutTraffic) -> SweepDetector:
    """Return a detector of single sweeps in the form that :meth:`DetectionTaskBase.detect` expects."""
    site_detector = detector.at_site(simulator.view, record.scene.roi)
    return lambda frame_sweeps: site_detector.detect(frame_sweeps[0])


def run_detectors(
    sites: Sequence[ViewpointT],
    task: DetectionTask[ViewpointT],
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: DetectionListener | None = None,
) -> dict[str, dict[str, DetectorResult]]:
    """Run every detector at every viewpoint; reuse cached results.

    Parameters
    ----------
    sites
        Sites, or groups of sites.
    task
        The detectors and the traffic.
    jobs
        Number of processes; one per core when None.

    Returns
    -------
    dict
        Results by viewpoint and detector, in the order of ``sites`` and ``task.names``.

    Raises
    ------
    InputError
        If a sensor cannot stand at a site, or a site has a measured scan.
    RunError
        If a worker process was killed.
    """
    listener = listener or DetectionListener()
    results: dict[str, dict[str, DetectorResult]] = {}
    missing: dict[str, list[str]] = {}
    for site in sites:
        results[site.name] = _read_cached_results(task, site)
        missing[site.name] = [name for name in task.names if name not in results[site.name]]
    work = [_SiteWork(site, missing[site.name]) for site in sites if missing[site.name]]
    processes = min(thread_count(jobs), len(work))
    done = len(sites) - len(work)

    listener.begins(missing, task.record.frames, processes)
    progress("sites", done, len(sites))
    with closing(_iter_site_results(task, work, processes)) as finished:
        for site, site_results, cost in finished:
            for name, result in site_results.items():
                _cache_result(result, task.key(site, name), cost)
            results[site.name].update(site_results)
            done += 1
            listener.site_done(site.name, missing[site.name], cost)
            progress("sites", done, len(sites))

    return {site.name: {name: results[site.name][name] for name in task.names} for site in sites}


# ---- cache

_FILE_STEMS: dict[type[DetectorResult], str] = {PointCounts: "points", DetectedBoxes: "detections"}
"""Stage name in the store and stem of the file, by kind of result."""


def _read_cached_results(task: DetectionTask[ViewpointT], site: ViewpointT) -> dict[str, DetectorResult]:
    """Return the cached results of a viewpoint, by detector."""
    results = {}
    for name in task.names:
        kind: type[DetectorResult] = PointCounts if name == POINT_COUNTS_NAME else DetectedBoxes
        result = _read_cached_result(kind, task.key(site, name))
        if result is not None:
            results[name] = result
    return results


def _read_cached_result(kind: type[DetectorResult], key: str) -> DetectorResult | None:
    stem = _FILE_STEMS[kind]
    with files.temporary_folder() as folder:
        if Store.default().take(stem, key, folder, link=True) is None:
            return None
        return kind.read(folder / f"{stem}.parquet")


def _cache_result(result: DetectorResult, key: str, cost: ResourceUsage) -> None:
    stem = _FILE_STEMS[type(result)]
    with files.temporary_folder() as folder:
        path = folder / f"{stem}.parquet"
        result.write(path, {"inputs": key})
        store = Store.default()
        with store.maker(stem, key, wait=False) as is_maker:
            if is_maker:  # otherwise another process is storing the same result
                artefacts = {path.name: files.hash_file(path)}
                store.put(stem, key, folder, stage_registry.StageResult(artefacts, {}, {}, cost))


# ---- worker processes


class _SiteWork(NamedTuple):
    """A viewpoint and the detectors to run there."""

    site: Any
    detectors: Sequence[str]


class _SiteResults(NamedTuple):
    """The results at a viewpoint, by detector, and what they cost."""

    site: Any
    results: dict[str, DetectorResult]
    cost: ResourceUsage


def _iter_site_results(
    task: DetectionTask[Any], work: Sequence[_SiteWork], processes: int
) -> Generator[_SiteResults, None, None]:
    """Yield the results of each viewpoint as they are finished."""
    if processes > 1:
        yield from _run_in_pool(task, work, processes)
        return
    for site_work in work:
        yield _run_site(task, site_work)


def _run_site(task: DetectionTask[Any], work: _SiteWork) -> _SiteResults:
    with measure_usage() as cost:
        results = task.at(work.site, work.detectors)
    return _SiteResults(work.site, results, cost)


def _run_in_pool(
    task: DetectionTask[Any], work: Sequence[_SiteWork], processes: int
) -> Generator[_SiteResults, None, None]:
    """Yield results from worker processes; an error or an interrupt ends all of them."""
    check_main_guard()
    other_processes = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _init_worker, (task,))
    try:
        with _BlockedInterrupts():
            futures = [pool.submit(_run_in_worker, site_work) for site_work in work]
        for future in as_completed(futures):
            yield future.result()
        pool.shutdown()
    except BrokenProcessPool:
        raise RunError(
            "a worker process was killed, perhaps because memory ran out. Use fewer --jobs; finished sites are cached."
        ) from None
    finally:
        for process in set(multiprocessing.active_children()) - other_processes:
            process.terminate()
        pool.shutdown(cancel_futures=True)


class _BlockedInterrupts:
    """Blocks SIGINT while worker processes start.

    They inherit the blocked signal. So an interrupt at the terminal, which reaches all processes, is handled by this
    process alone.
    """

    def __enter__(self) -> None:
        self._previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])

    def __exit__(self, *_: object) -> None:
        signal.pthread_sigmask(signal.SIG_SETMASK, self._previous_mask)


_worker_task: DetectionTask[Any] | None = None
"""The task of this process, if it is a worker."""


def _init_worker(task: DetectionTask[Any]) -> None:
    global _worker_task
    _worker_task = task
    os.environ["OMP_NUM_THREADS"] = "1"  # before scikit-learn is imported: its threads would wait for each other
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    """End this worker when its parent is gone; otherwise it would wait for work forever."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _run_in_worker(work: _SiteWork) -> _SiteResults:
    assert _worker_task is not None
    return _run_site(_worker_task, work)
