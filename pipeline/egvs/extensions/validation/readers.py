"""Formats of labels of sweeps; see :mod:`egvs.formats.sweep_labels`."""

from __future__ import annotations

from egvs.core.readers import Reader

_MEASURED = "egvs.extensions.validation.measured"

READERS = (
    Reader("KITTI labels", "labels", f"{_MEASURED}.kitti_labels", suffixes=(".txt",)),
    Reader("table of labels (CSV)", "labels", f"{_MEASURED}.label_tables", suffixes=(".csv",)),
)
