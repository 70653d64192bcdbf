"""Files of a validation in a run folder."""

from __future__ import annotations

from egvs.artefacts.run_folder import RunFile

DETECTION = RunFile("detection.parquet", "validate")
CORRELATION = RunFile("correlation.parquet", "validate")
FIGURE = RunFile("validation.png", "validate")
SURROGATES = RunFile("surrogates.parquet", "validate")
FUSED = RunFile("fused.parquet", "validate")
MEASURED = RunFile("measured.json", "validate")
CHECKSUMS = RunFile("validation.sha256", "validate")

FILES = (DETECTION, CORRELATION, FIGURE, SURROGATES, FUSED, MEASURED, CHECKSUMS)
"""All files; the entry point of the group ``egvs.files``."""
