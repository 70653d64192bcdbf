"""Makes a folder of labelled point clouds: one folder a site, and a README that says what is in them.

The folder appears whole or not at all: it is written aside (``.<name>.partial``) and renamed at the end. An export that
was interrupted leaves its traffic and its static world in the store, and the next one begins its clouds anew; what is
left of one that was killed is removed then.
"""

from __future__ import annotations

import difflib
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core import files
from pipeline.core.errors import InputError, RunError
from pipeline.core.parallel import threads
from pipeline.core.progress import Progress, silent
from pipeline.runs import locking
from pipeline.scenario.models import Scenario
from pipeline.sensing import sites as all_sites
from pipeline.sensing.scanner import Scanner
from pipeline.sensing.scene import Scene
from pipeline.sensing.sites import Site
from pipeline.validation import unseen_record
from pipeline.validation.clouds import bodies, point_clouds
from pipeline.validation.clouds.point_clouds import CloudMaker
from pipeline.validation.exports import openpcdet, readme
from pipeline.validation.exports.layouts import LAYOUTS, Layout
from pipeline.validation.exports.sites import SiteSummary, write_site
from pipeline.validation.unseen_record import UnseenRecord

README = "README.md"
_RECORD = ".record"


@dataclass(frozen=True)
class Export:
    """A folder that was written."""

    folder: Path
    kind: str
    frames: int
    sites: tuple[SiteSummary, ...]


def export(
    scenario: Scenario,
    folder: Path,
    *,
    sites: Sequence[str] = (),
    frames: int = 1000,
    kind: str = "kitti",
    jobs: int | None = None,
    progress: Progress = silent,
) -> Export:
    """Write labelled point clouds of a scenario's sites in frames of unseen traffic.

    Parameters
    ----------
    folder
        New or empty; nothing is overwritten.
    sites
        Names; all sites when there is none.
    frames
        How many of each site.
    kind
        One of :data:`pipeline.validation.exports.layouts.LAYOUTS`.
    jobs
        Threads; one a core when None. The files do not depend on it.

    Raises
    ------
    InputError
        For an unknown format or site; a folder that holds something; a site whose empty scan is measured; too little
        room on the disk; more frames than traffic has; and what the stages refuse.
    """
    if kind not in LAYOUTS:
        raise InputError("--format", repr(kind), f"one of {', '.join(LAYOUTS)}")
    _check_free(folder)
    chosen = _chosen(all_sites.of(scenario), sites)
    with _aside(folder) as partial:
        record = unseen_record.prepare(scenario, partial / _RECORD, frames, jobs=jobs, progress=progress)
        standing = _standing(record.scene, [site.name for site in chosen], named=bool(sites))
        written = _write_sites(partial, folder, record, standing, LAYOUTS[kind], threads(jobs), progress)
        for about in written if kind == "openpcdet" else ():
            files.write_text(partial / about.site / openpcdet.FILE, openpcdet.configuration(about))
        files.write_text(partial / README, readme.text(record, kind, written))
        shutil.rmtree(partial / _RECORD)
    return Export(folder, kind, frames, tuple(written))


def _write_sites(
    partial: Path,
    folder: Path,
    record: UnseenRecord,
    sites: Sequence[Site],
    layout: Layout,
    jobs: int,
    progress: Progress,
) -> list[SiteSummary]:
    scanner, shapes = Scanner(record.scene, whole=True), bodies.of_scenario(record.scene.scenario)
    scanner.check(sites)
    written: list[SiteSummary] = []
    for site in sites:
        maker = CloudMaker.of_site(record.scene, site, scanner, shapes)
        if not written:
            _check_room(partial, folder, maker, record, sites, layout)
        done, total = len(written) * record.frames, len(sites) * record.frames

        def told(what: str, here: int, _: int, done: int = done, total: int = total) -> None:
            progress(what, done + here, total)

        written.append(write_site(partial / site.name, record, maker, layout, jobs, told))
    return written


def _chosen(known: Sequence[Site], names: Sequence[str]) -> list[Site]:
    """The sites of these names, or all, in the scenario's order; InputError for what cannot be exported."""
    by_name = {site.name: site for site in known}
    for name in names:
        if name not in by_name:
            near = difflib.get_close_matches(name, by_name, 1, 0.4)
            listed = [*by_name][:20]
            more = f" and {len(by_name) - len(listed)} more" if len(by_name) > len(listed) else ""
            right = f"did you mean {near[0]}?" if near else f"one of {', '.join(listed)}{more}"
            raise InputError("--site", f"no site {name!r}", right)
    chosen = [site for site in known if not names or site.name in names]
    for site in chosen:
        point_clouds.check(site)
        if site.name.startswith(".") or site.name.casefold() == README.casefold():
            raise InputError(f"site {site.name}", "its name cannot be that of a folder here", "another name")
    return chosen


def _standing(scene: Scene, names: Sequence[str], *, named: bool) -> list[Site]:
    """The sites of the scene; InputError for one that was asked for by name, but that no pole can stand for."""
    why = {site.name: reason for site, reason in scene.dropped}
    for name in names if named else ():
        if name in why:
            raise InputError("--site", f"the site {name!r} is dropped: it stands {why[name]}", "one that is scanned")
    return [site for site in scene.sites if site.name in names]


def _check_free(folder: Path) -> None:
    """InputError for a folder that holds something."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}", "is a file", "a folder that is new or empty")
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"--out {folder}", "holds files already", "a folder that is new or empty: none is overwritten")


@contextmanager
def _aside(folder: Path) -> Iterator[Path]:
    """Yield a folder to write to; rename it at the end, remove it where that is not reached."""
    target = folder.resolve()
    partial = target.with_name(f".{target.name}.partial")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        lock = target.with_name(f".{target.name}.lock")
        locking.make(lock)
    except OSError as error:
        raise InputError(f"--out {folder}", f"cannot be written ({error.strerror})", "a folder of yours") from None
    with locking.locked(lock, wait=False, remove=True) as held:
        if not held:
            raise RunError(f"{folder}: another export is at work there")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        try:
            with files.naming(target):
                yield partial
            partial.replace(target)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise


def _check_room(
    partial: Path, folder: Path, maker: CloudMaker, record: UnseenRecord, sites: Sequence[Site], layout: Layout
) -> None:
    """InputError where the clouds of all sites would not fit on the disk, if as many beams return as at the first."""
    share = float(np.isfinite(maker.view.empty_range_m).mean())
    beams = sum(record.scene.sensor(site.sensor).beams for site in sites)
    need, free = beams * share * record.frames * layout.point_bytes, shutil.disk_usage(partial).free
    if need > free:
        found = f"about {need / 1e9:,.1f} GB of points, but {free / 1e9:,.1f} GB are free there"
        raise InputError(f"--out {folder}", found, "fewer --frames, fewer sites (--site), or another disk")
