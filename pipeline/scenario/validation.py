"""The keys of ``[validation]``: what detection is measured with, where it is not the program's own."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipeline.core.strict_model import StrictModel

BodyKind = Literal[
    "sedan", "kei", "taxi", "van", "truck", "bus", "tractor", "trailer", "pedestrian", "bicycle"
]  # fmt: skip
"""Kinds of bodies that point clouds are made with."""


class ValidationModel(StrictModel):
    """How it is measured what detectors find."""

    bodies: dict[BodyKind, str] = Field(
        default_factory=dict,
        description="A mesh (PLY, OBJ, STL, GLB; x ahead, y left, z up) instead of the program's own body of a kind, "
        "stretched to each box",
    )
