"""Records that the program keeps for itself say their own hash, so that any damage is noticed, at whatever depth.

A seal is no signature: who may write the file may seal it anew.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from pipeline.core import files

SEAL = "own_sha256"
"""The key of a record that holds the hash of all else in it."""


def sealed(value: Mapping[str, Any]) -> dict[str, Any]:
    """A record with its hash as the last key."""
    kept = {key: part for key, part in value.items() if key != SEAL}
    return {**kept, SEAL: files.hash_of(json.loads(files.json_text(kept)))}


def is_sealed(value: Any) -> bool:
    """Whether a record, as JSON gives it, says its own hash."""
    return isinstance(value, dict) and value.get(SEAL) == files.hash_of({k: v for k, v in value.items() if k != SEAL})
