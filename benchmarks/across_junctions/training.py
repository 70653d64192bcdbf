"""Fit the models of ``expected_detections`` to the records of the training junctions, and compare their features.

The detector PointPillars is trained before, at other junctions and some of these.

Each vehicle-frame of the unseen traffic, as seen from each candidate, is a row: its features, and in how many of the
two views it was found. Every model is tested on each junction with the models of the others
(:mod:`benchmarks.across_junctions.models.comparison`, where groups are candidates of equal height). Records of other
roles are never read.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import sklearn

from benchmarks.across_junctions import study_detectors
from benchmarks.across_junctions.detections import settings_digest
from benchmarks.across_junctions.models import comparison, figures, model_file
from benchmarks.across_junctions.models.comparison import SiteRows
from benchmarks.across_junctions.models.fitting import Examples, cross_validate, fit_model
from benchmarks.across_junctions.protocol import Protocol, ProtocolFiles
from benchmarks.across_junctions.records import info_path, read_junction
from benchmarks.across_junctions.vehicle_rows import read_rows
from egvs.core import files
from egvs.core.errors import InputError
from egvs.scoring.target_scores import FEATURES

MIN_JUNCTIONS = 2
"""Each is predicted by the model of the others."""


def read_training(
    records_folder: Path, protocol: Protocol, detector: str, without: Collection[str] = ()
) -> dict[str, list[SiteRows]]:
    """Return the rows of the training junctions where a detector was run, by junction and candidate.

    Parameters
    ----------
    without
        Junctions to leave out.

    Raises
    ------
    InputError
        If a record is damaged, is a trial, or was measured with another version of the detector or of the protocol; or
        if fewer than two junctions were measured.
    """
    each = {}
    settings, protocol_digest = settings_digest(detector), ProtocolFiles().digest
    for junction in protocol.junctions:
        path = info_path(records_folder, junction.name, detector)
        if junction.role != "training" or junction.name in without or not path.is_file():
            continue
        record = read_junction(records_folder, junction.name)
        info = record.infos[detector]
        if (info.settings, info.protocol, info.is_trial) != (settings, protocol_digest, False):
            problem = f"expected {detector} as it is installed, under this protocol, with all frames and candidates"
            raise InputError(path, problem, f"Measure it again: measure --junction {junction.name} --part {detector}.")
        each[junction.name] = read_rows(records_folder, record, detector)
    if len(each) < MIN_JUNCTIONS:
        problem = f"expected {MIN_JUNCTIONS} training junctions with {detector}, got {', '.join(each) or 'none'}"
        raise InputError(records_folder, problem, "Measure them: across_junctions measure --role training.")
    return each


def check_complete(by_junction: Mapping[str, Sequence[SiteRows]], protocol: Protocol, detector: str) -> None:
    """Check that every training junction was measured.

    Raises
    ------
    InputError
        Otherwise.
    """
    names = [junction.name for junction in protocol.junctions if junction.role == "training"]
    if missing := [name for name in names if name not in by_junction]:
        problem = f"{', '.join(missing)} not measured with {detector}"
        raise InputError("--write", problem, "The shipped models need all training junctions.")


def compare(by_junction: Mapping[str, Sequence[SiteRows]], detector: str, out: Path) -> list[str]:
    """Write the comparison of models of one detector as Markdown, with a figure, and return its lines."""
    lines = [f"{detector}: groups are candidates of equal height", ""]
    lines += [*comparison.table(comparison.compare(by_junction)), ""]
    out.mkdir(parents=True, exist_ok=True)
    files.write_text(out / f"comparison_{detector}.md", "\n".join(lines))
    curves = comparison.reliability(by_junction, comparison.MODELS[comparison.SHIPPED_FORM])
    figures.draw_reliability(out / f"reliability_{detector}.png", detector, curves)
    return lines


def fitted_models(records_folder: Path, protocol: Protocol) -> str:
    """Return the file of models, ``target_scores.json``, fitted to all training junctions.

    Raises
    ------
    InputError
        As :func:`read_training` and :func:`check_complete`.
    """
    models, settings = {}, {}
    learnt_on: dict[str, model_file.TrainingJunction] = {}
    sites: dict[str, dict[str, int]] = {}
    for detector in (*protocol.detectors.training, study_detectors.SENSOR):
        by_junction = read_training(records_folder, protocol, detector)
        check_complete(by_junction, protocol, detector)
        examples = {name: _examples(rows) for name, rows in by_junction.items()}
        models[detector] = fit_model(list(examples.values())) | {"elsewhere": cross_validate(examples)}
        settings[detector] = settings_digest(detector)
        for name, rows in by_junction.items():
            sites.setdefault(name, {})[detector] = len(rows)
            sensors = tuple(sorted(set(read_junction(records_folder, name).sensors)))
            learnt_on[name] = model_file.TrainingJunction(sites[name], sensors, len(rows[0].hits))
    metadata = model_file.TrainingMetadata(learnt_on, protocol.training_frames, settings, sklearn.__version__)
    return model_file.text(metadata, models)


def _examples(rows: Sequence[SiteRows]) -> Examples:
    features = [np.column_stack([site.features.columns[name] for name in FEATURES]) for site in rows]
    return Examples(features, [site.hits for site in rows], [site.ap for site in rows])
