"""The sensor catalogue, as ``catalogue.toml`` beside this module holds it.

Each entry has the keys of ``[sensors.<name>]``, its source, and what is not the maker's but assumed.
"""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path

from pydantic import Field

from pipeline.core import files
from pipeline.scenario.sensors import SensorModel

FILE = Path(__file__).with_name("catalogue.toml")


class CatalogueEntry(SensorModel):
    """A sensor of the catalogue."""

    source: str = Field(min_length=1, description="The maker's document, or what else the numbers are from")
    assumed: str = Field("", description="What the source does not say")


@cache
def entries() -> dict[str, CatalogueEntry]:
    """All entries by name, in the order of the file."""
    with FILE.open("rb") as file:
        return {name: CatalogueEntry.of(values) for name, values in tomllib.load(file).items()}


def digest(name: str) -> str:
    """Hex digest of what an entry says of its beams and optics; the noise of its ranges is in no empty scan."""
    return files.hash_of(entries()[name].model_dump(mode="json", exclude={"source", "assumed", "range_sigma_m"}))
