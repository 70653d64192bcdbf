"""Typical kinds of road users, from ``kinds.toml`` beside this module."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FILE = Path(__file__).with_name("kinds.toml")


@dataclass(frozen=True)
class Kinds:
    """A table of kinds.

    Attributes
    ----------
    size_m
        Length, width, height, (k, 3) float64.
    share
        How often each is met, (k,) float64, of any sum.
    is_vehicle
        (k,) bool.
    """

    names: tuple[str, ...]
    size_m: NDArray[np.float64]
    share: NDArray[np.float64]
    is_vehicle: NDArray[np.bool_]


@cache
def kinds() -> Kinds:
    """All kinds of the table."""
    with FILE.open("rb") as file:
        rows = tomllib.load(file)["kind"]
    return Kinds(
        tuple(row["name"] for row in rows),
        np.array([row["size_m"] for row in rows], dtype=np.float64),
        np.array([row["share"] for row in rows], dtype=np.float64),
        np.array([row.get("vehicle", True) for row in rows], dtype=np.bool_),
    )
