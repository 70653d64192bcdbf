"""Fit the models of ``expected_detections`` to the records of the training junctions, and compare their features.

The detector PointPillars is trained before, at other junctions and some of these.

Each vehicle-frame of the unseen traffic, as seen from each candidate, is a row: its features, and in how many of the
two views it was found. Every model is tested on each junction with the models of the others
(:mod:`benchmarks.detectability.comparison`, where groups are candidates of equal height). Records of other roles are
never read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import sklearn

from benchmarks.across_junctions.protocol import Protocol
from benchmarks.across_junctions.records import read_junction
from benchmarks.across_junctions.vehicle_rows import read_rows
from benchmarks.detectability import comparison, figures, writing
from benchmarks.detectability.comparison import SiteRows
from benchmarks.detectability.fitting import Examples, cross_validate, fit_model
from egvs.core import files
from egvs.core.errors import InputError
from egvs.scoring.target_scores import FEATURES
from egvs.validation.detectors import base

MIN_JUNCTIONS = 2
"""Each is predicted by the model of the others."""


def read_training(records_folder: Path, protocol: Protocol, detector: str) -> dict[str, list[SiteRows]]:
    """Return the rows of the training junctions where a detector was run, by junction and candidate.

    Raises
    ------
    InputError
        If a record is damaged, or fewer than two junctions were measured.
    """
    each = {}
    for junction in protocol.junctions:
        if junction.role == "training" and (records_folder / f"{junction.name}.{detector}.json").is_file():
            record = read_junction(records_folder, junction.name)
            each[junction.name] = read_rows(records_folder, record, detector)
    if len(each) < MIN_JUNCTIONS:
        problem = f"expected {MIN_JUNCTIONS} training junctions with {detector}, got {', '.join(each) or 'none'}"
        raise InputError(records_folder, problem, "Measure them: across_junctions measure --role training.")
    return each


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
        As :func:`read_training`.
    """
    models, settings = {}, {}
    learnt_on: dict[str, writing.TrainingJunction] = {}
    sites: dict[str, dict[str, int]] = {}
    for detector in protocol.detectors.training:
        by_junction = read_training(records_folder, protocol, detector)
        examples = {name: _examples(rows) for name, rows in by_junction.items()}
        models[detector] = fit_model(list(examples.values())) | {"elsewhere": cross_validate(examples)}
        settings[detector] = files.hash_json(base.make_detector(detector).settings)
        for name, rows in by_junction.items():
            sites.setdefault(name, {})[detector] = len(rows)
            sensors = tuple(sorted(set(read_junction(records_folder, name).sensors)))
            learnt_on[name] = writing.TrainingJunction(sites[name], sensors, len(rows[0].hits))
    metadata = writing.TrainingMetadata(learnt_on, protocol.training_frames, settings, sklearn.__version__)
    return writing.text(metadata, models)


def _examples(rows: Sequence[SiteRows]) -> Examples:
    features = [np.column_stack([site.features.columns[name] for name in FEATURES]) for site in rows]
    return Examples(features, [site.hits for site in rows], [site.ap for site in rows])
