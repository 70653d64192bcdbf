"""The scenario file ``scenario.toml``: its keys as typed models, and loading."""

from __future__ import annotations

from typing import TYPE_CHECKING

from egvs.core.lazy import lazy_exports

if TYPE_CHECKING:
    from egvs.scenario.loading import json_schema, load
    from egvs.scenario.model import Scenario

__all__ = ["Scenario", "json_schema", "load"]

__getattr__, __dir__ = lazy_exports(__name__, {"loading": ["json_schema", "load"], "model": ["Scenario"]})
