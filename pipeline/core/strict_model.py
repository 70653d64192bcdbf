"""The base of what users write: values checked the same way everywhere.

Models are frozen, unknown keys are errors, and numbers are finite unless a field says otherwise. No text or truth value
passes for a number, no fraction for a count; lists pass for tuples, as in JSON.
"""

from __future__ import annotations

import json
from typing import Any, Self

from pydantic import BaseModel, ConfigDict


class StrictModel(BaseModel):
    """Base of everything that is read from a scenario."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def of(cls, values: dict[str, Any]) -> Self:
        """From values as TOML gives them; pydantic's ValidationError when they are wrong."""
        return cls.model_validate_json(json.dumps(values, default=str), strict=True)
