"""Looks at all frames from each site with each detector, on all cores; what the store has is not looked at again.

Places are sites, or several sites at once (:mod:`pipeline.validation.fused`). A place is one task: its sweeps are made
once for all detectors that miss. Random numbers belong to a site and a frame, so neither cores nor order matter.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from pipeline.artefacts import schemas
from pipeline.core import code_digest, files, parallel
from pipeline.core.cost import Cost, measured
from pipeline.core.errors import RunError
from pipeline.core.progress import Progress, silent
from pipeline.effects import registry as effects
from pipeline.effects.base import Effect
from pipeline.runs.stages import Made
from pipeline.runs.store import Store
from pipeline.sensing.scanner import Scanner
from pipeline.sensing.sites import Site
from pipeline.stages.shared.scene import sensor_digests
from pipeline.validation.clouds import bodies
from pipeline.validation.clouds.point_clouds import CloudMaker, random_of
from pipeline.validation.detectors.base import Detector, SiteDetector
from pipeline.validation.metrics.matching import within
from pipeline.validation.site_findings import POINTS, Found, FoundBoxes, FoundPoints
from pipeline.validation.sweeps import Detections, Sweep
from pipeline.validation.unseen_record import UnseenRecord


class Place(Protocol):
    """What is looked from: it has a name of its own."""

    @property
    def name(self) -> str:
        """Among the places that are looked from at once."""
        raise NotImplementedError


Finder = Callable[[Sequence[Sweep]], Detections]
"""Finds vehicles in the sweeps of one instant."""

PlaceT = TypeVar("PlaceT", bound=Place)
PlaceT_contra = TypeVar("PlaceT_contra", bound=Place, contravariant=True)


class Looking(Protocol[PlaceT_contra]):
    """A record seen from places of one kind by some detectors; can be sent to another process."""

    @property
    def record(self) -> UnseenRecord:
        """Whose frames are looked at."""
        raise NotImplementedError

    @property
    def names(self) -> list[str]:
        """The detectors, points on vehicles first."""
        raise NotImplementedError

    def at(self, place: PlaceT_contra, names: Sequence[str]) -> dict[str, Found]:
        """What some of the detectors find from a place."""
        raise NotImplementedError

    def key(self, place: PlaceT_contra, name: str) -> str:
        """Hash of everything that a detector's findings from a place depend on."""
        raise NotImplementedError


class LookListener:
    """Hears how far the looking is; this one does nothing with it."""

    def begins(self, missing: Mapping[str, Sequence[str]], frames: int, processes: int) -> None:
        """Once: the detectors that have to look from each site; none where all was kept."""

    def looked(self, site: str, detectors: Sequence[str], cost: Cost) -> None:
        """A site is done, for these detectors."""


DetectorT = TypeVar("DetectorT", bound=Detector)


@dataclass(frozen=True)
class RecordLook(Generic[DetectorT]):
    """A record seen by some detectors: what looking from one site and from several has in common.

    Attributes
    ----------
    detectors
        By name; points on vehicles are always counted.
    """

    record: UnseenRecord
    detectors: Mapping[str, DetectorT]

    @property
    def names(self) -> list[str]:
        """The detectors, points on vehicles first."""
        return [POINTS, *self.detectors]

    @cached_property
    def scanner(self) -> Scanner:
        """Scans of all beams."""
        return Scanner(self.record.scene, whole=True)

    def makers(self, sites: Sequence[Site]) -> list[CloudMaker]:
        """What makes the sweeps of some sites."""
        scene = self.record.scene
        shapes = bodies.of_scenario(scene.scenario)
        return [CloudMaker.of_site(scene, site, self.scanner, shapes) for site in sites]

    def found(
        self, makers: Sequence[CloudMaker], finders: Mapping[str, Finder], *, with_points: bool
    ) -> dict[str, Found]:
        """What is found in the sweeps of all frames, by name.

        Parameters
        ----------
        finders
            By name; each is given the sweeps of one instant, in the order of the makers.
        with_points
            Whether the points on vehicles are counted too, those of all makers together.
        """
        roi, seed = self.record.scene.roi, self.record.scenario.seed
        points, boxes = [], {name: list[Detections]() for name in finders}
        for frame in self.record.read():
            swept = [maker.sweep(frame, random_of(seed, maker.view.site, frame.number)) for maker in makers]
            on = np.array([its.points_on(len(frame.boxes)) for its in swept])
            points.append(on[:, frame.wanted(roi)].sum(axis=0))
            sweeps = [its.sweep for its in swept]
            for name, finder in finders.items():
                boxes[name].append(within(finder(sweeps), roi))
        found: dict[str, Found] = {name: FoundBoxes(tuple(its)) for name, its in boxes.items()}
        return found | ({POINTS: FoundPoints(tuple(points))} if with_points else {})


@dataclass(frozen=True)
class Look(RecordLook[Detector]):
    """A record seen from its sites by some detectors."""

    def at(self, site: Site, names: Sequence[str]) -> dict[str, Found]:
        """What some of the detectors find from a site."""
        (maker,) = self.makers([site])
        ready = {n: self.detectors[n].at(maker.view, self.record.scene.roi) for n in names if n != POINTS}
        return self.found([maker], {n: _of_one(its) for n, its in ready.items()}, with_points=POINTS in names)

    def key(self, site: Site, name: str) -> str:
        """Hash of everything that a detector's findings from a site depend on."""
        scene, scenario = self.record.scene, self.record.scenario
        detector = self.detectors.get(name)
        own, acting = scenario.sensors.get(site.sensor), scene.acting(Effect)
        modules = [__name__, *effects.modules(acting), *([type(detector).__module__] if detector else [])]
        sources = [code_digest.of(module) for module in modules]
        about = {
            "detector": [name, detector.settings if detector else {}],
            "record": [self.record.keys, self.record.numbers.tolist(), scenario.seed],
            "site": [site.name, site.pose.position_m, site.pose.angles_deg],
            "sensor": [site.sensor, own.model_dump(mode="json") if own else None, sensor_digests(scenario, [site])],
            "bodies": bodies.digests(scenario),
            "effects": effects.settings(acting),
            "roi": [scene.roi.origin_m, scene.roi.size_m],
            "program": [source.digest for source in sources],
            "libraries": code_digest.versions(frozenset[str]().union(*(source.libraries for source in sources))),
            "schema": schemas.VERSION,
        }
        return files.hash_of(about)


def _of_one(detector: SiteDetector) -> Finder:
    return lambda sweeps: detector.detect(sweeps[0])


_KIND = {FoundPoints: "points", FoundBoxes: "detections"}
"""What the store calls them; the file has the same name."""


def look_from(
    sites: Sequence[PlaceT],
    look: Looking[PlaceT],
    *,
    jobs: int | None = None,
    progress: Progress = silent,
    listener: LookListener | None = None,
) -> dict[str, dict[str, Found]]:
    """What every detector finds from each site, by site and detector, in their order.

    Parameters
    ----------
    jobs
        Processes; one a core when None.

    Raises
    ------
    InputError
        For a site where no sensor can stand, or whose scan was measured.
    RunError
        Where a process was ended from outside.
    """
    names, told = look.names, listener or LookListener()
    found: dict[str, dict[str, Found]] = {}
    for site in sites:
        known = {name: _taken(_kind_of(name), look.key(site, name)) for name in names}
        found[site.name] = {name: its for name, its in known.items() if its is not None}
    missing = {site.name: [name for name in names if name not in found[site.name]] for site in sites}
    tasks = [(site, missing[site.name]) for site in sites if missing[site.name]]
    done, processes = len(sites) - len(tasks), min(parallel.threads(jobs), len(tasks))
    told.begins(missing, look.record.frames, processes)
    progress("sites looked from", done, len(sites))
    with closing(_each(look, tasks, processes)) as each:
        for site, its, cost in each:
            for name, what in its.items():
                _put(_kind_of(name), look.key(site, name), what, cost)
            found[site.name] |= its
            done += 1
            told.looked(site.name, missing[site.name], cost)
            progress("sites looked from", done, len(sites))
    return {site.name: {name: found[site.name][name] for name in names} for site in sites}


def _each(
    look: Looking[PlaceT], tasks: Sequence[tuple[PlaceT, Sequence[str]]], processes: int
) -> Generator[tuple[PlaceT, dict[str, Found], Cost], None, None]:
    """Every task's findings, as they are ready; when an error or an interrupt ends it, what is at work ends too."""
    if processes <= 1:
        for task in tasks:
            yield task[0], *_looked(look, task)
        return
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _begin, (look,))
    try:
        waiting = _submitted(pool, tasks)
        for future in as_completed(waiting):
            yield waiting[future], *future.result()
        pool.shutdown()
    except BrokenProcessPool:
        cure = "was memory short? fewer --jobs need less, and what is done is kept"
        raise RunError(f"a process that looked from a site was ended from outside; {cure}") from None
    finally:
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        pool.shutdown(cancel_futures=True)


def _submitted(
    pool: ProcessPoolExecutor, tasks: Sequence[tuple[PlaceT, Sequence[str]]]
) -> dict[Future[tuple[dict[str, Found], Cost]], PlaceT]:
    """All tasks, begun. Processes begin with the signals that are blocked here, and keep to that: an interrupt at the
    terminal reaches all, and is answered by the one that the user sees."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        return {pool.submit(_work, task): task[0] for task in tasks}
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _looked(look: Looking[PlaceT], task: tuple[PlaceT, Sequence[str]]) -> tuple[dict[str, Found], Cost]:
    with measured() as cost:
        found = look.at(*task)
    return found, cost


_ready: Looking[Any] | None = None
"""In a process of the pool: what it looks with."""


def _begin(look: Looking[Any]) -> None:
    global _ready
    _ready = look
    os.environ["OMP_NUM_THREADS"] = "1"  # before scikit-learn is loaded: its threads would wait for one another
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A pool's process would wait for work for ever where its parent was killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _work(task: tuple[Place, Sequence[str]]) -> tuple[dict[str, Found], Cost]:
    assert _ready is not None
    return _looked(_ready, task)


def _kind_of(name: str) -> type[Found]:
    return FoundPoints if name == POINTS else FoundBoxes


def _taken(kind: type[Found], key: str) -> Found | None:
    """From the store; None where it is not there."""
    with files.scratch() as folder:
        if Store.default().take(_KIND[kind], key, folder, link=True) is None:
            return None
        return kind.read(folder / f"{_KIND[kind]}.parquet")


def _put(kind: type[Found], key: str, found: Found, cost: Cost) -> None:
    """Into the store."""
    name = f"{_KIND[kind]}.parquet"
    with files.scratch() as folder:
        path = folder / name
        found.write(path, {"inputs": key})
        store = Store.default()
        with store.maker(_KIND[kind], key, wait=False) as mine:
            if mine:  # else another process is putting the same
                store.put(_KIND[kind], key, folder, Made({name: files.sha256_of(path)}, {}, {}, cost))
