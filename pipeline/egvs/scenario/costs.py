"""The costs of a finished run, with overrides of the command line."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import ValidationError

from egvs.core.errors import InputError
from egvs.scenario.fields import StrictModel
from egvs.scenario.loading import apply_overrides, format_validation_error
from egvs.scenario.score_config import CostsConfig


class _CostsTable(StrictModel):
    costs: CostsConfig


def costs_from_dict(values: Mapping[str, Any], overrides: Iterable[str], where: str) -> CostsConfig:
    """Check the costs of a scenario that is given as nested dictionaries, as in ``run.json``.

    Parameters
    ----------
    values
        Tables and keys.
    overrides
        ``"costs.key=value"``, as in :func:`egvs.scenario.loading.load`.
    where
        The file, for messages.

    Raises
    ------
    InputError
        When costs are invalid, or an override is of another table.
    """
    overrides = tuple(overrides)
    for override in overrides:
        if not override.strip().startswith("costs."):
            problem = "expected a key of [costs], because the runs are finished"
            hint = "Use, for example, --set costs.pole=12000, or run the scenario again with --sensors."
            raise InputError(f"--set {override}", problem, hint)
    tables = apply_overrides({"costs": dict(values.get("costs", {}))}, overrides)
    if overrides:
        where = "--set"
    try:
        return _CostsTable.model_validate(tables).costs
    except ValidationError as error:
        raise format_validation_error(error, where, _CostsTable) from None
