"""Create scenarios with options given as keywords."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from egvs.creation import new_scenario
from egvs.creation.new_scenario import NewScenario, NewScenarioOptions


def create_scenario(
    folder: Path, maps: Path | Sequence[Path], at: tuple[float, float] | None = None, **options: Any
) -> NewScenario:
    """Call :func:`egvs.creation.new_scenario.create_scenario`."""
    return new_scenario.create_scenario(folder, maps, at, NewScenarioOptions(**options))
