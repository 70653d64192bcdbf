"""What every validation begins with: a folder to work in, the check, and whether there is anything to find."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pipeline.artefacts.traffic_frames import TrafficFrame
from pipeline.core.errors import InputError
from pipeline.core.findings import Finding, warnings_of
from pipeline.core.progress import Progress
from pipeline.runs import stage_keys, stages
from pipeline.scenario.models import Scenario
from pipeline.stages.base import Workspace
from pipeline.validation.unseen_record import UnseenRecord

_WORK = ".validate-"


@contextmanager
def workshop(out: Path) -> Iterator[Path]:
    """A folder to work in, within the run's folder, which is held; those that were killed have left theirs."""
    for left in out.glob(f"{_WORK}*"):
        shutil.rmtree(left)
    with tempfile.TemporaryDirectory(prefix=_WORK, dir=out) as folder:
        yield Path(folder)


def checked(scenario: Scenario, folder: Path, progress: Progress) -> list[Finding]:
    """What the check warns of; its errors are raised."""
    folder.mkdir()
    work = Workspace(scenario, folder, progress=progress)
    made = stages.make("check", work, stage_keys.inputs("check", work).read)
    return list(warnings_of([made.summary]))


def refuse_empty(scenario: Scenario, record: UnseenRecord, watched: Sequence[TrafficFrame]) -> None:
    """InputError where no vehicle is in the region of interest in any frame."""
    if not any(len(frame.wanted(record.scene.roi)) for frame in watched):
        found = f"no vehicle's centre is in it in any of {record.frames} frames of unseen traffic"
        raise InputError(f"{scenario.file}: roi", found, "a region with traffic, or more --frames")


def not_unseen(scenario: Scenario) -> list[Finding]:
    """A warning where the frames are those that the TPOG was counted from."""
    if not scenario.is_recorded:
        return []
    what = "the traffic is a finished file: sites are judged by frames that the TPOG was counted from"
    return [Finding("seen traffic", f"{scenario.file}: traffic.fcd", what, "a network or a sumocfg has traffic unseen")]
