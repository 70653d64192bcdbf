"""Take the demand of a new scenario from SUMO files as it is: a configuration, or a network and route files."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egvs.core.errors import InputError
from egvs.core.wording import number_of
from egvs.creation.junctions import StreetJunction, Streets
from egvs.formats import xml
from egvs.scenario.traffic_config import CountConfig
from egvs.traffic.user_files import read_sumocfg

_SUFFIXES = (".sumocfg", ".xml", ".xml.gz")


@dataclass(frozen=True)
class SumoDemand:
    """Vehicles of SUMO files.

    Attributes
    ----------
    folder
        The scenario's folder.
    sumocfg, routes
        The configuration, or else the route files.
    """

    folder: Path
    sumocfg: Path | None
    routes: tuple[Path, ...]

    flows: tuple[CountConfig, ...] = ()
    notes: tuple[str, ...] = ()
    assumptions: tuple[str, ...] = ()
    is_recorded = False

    def describe(self) -> str:
        """Return a sentence."""
        if self.sumocfg is not None:
            return f"as in {self.sumocfg.name}"
        return f"as in {number_of(len(self.routes), 'route file')}"

    def warnings(self, _scenario_file: Path) -> Iterator[str]:
        """Yield nothing: the demand is the user's."""
        yield from ()

    def add_keys(self, table: Any, _streets: Streets, _junction: StreetJunction) -> None:
        """Name the files in ``[traffic]``, by paths from the scenario's folder."""
        if self.sumocfg is not None:
            table.remove("network")
            table.add("sumocfg", self._relative(self.sumocfg))
        else:
            table.add("routes", [self._relative(path) for path in self.routes])

    def _relative(self, path: Path) -> str:
        return Path(os.path.relpath(path.resolve(), self.folder.resolve())).as_posix()


def split_demand(folder: Path, paths: Sequence[Path]) -> tuple[list[Path], SumoDemand | None]:
    """Separate SUMO's demand from maps.

    Parameters
    ----------
    folder
        Folder of the new scenario.
    paths
        Files of the user.

    Returns
    -------
    list of Path, SumoDemand or None
        The maps, with the network of a configuration in place of it; and the demand, if there is any.

    Raises
    ------
    InputError
        When there are several configurations, a configuration and route files, or a wrong configuration.
    """
    by_root = {path: _root(path) for path in paths}
    configurations = [path for path, root in by_root.items() if root == "configuration"]
    routes = tuple(path for path, root in by_root.items() if root == "routes")
    if len(configurations) > 1 or (configurations and routes):
        others = [*configurations, *routes]
        problem = f"expected one SUMO configuration, or route files, got {others[0]} and {others[1]}"
        raise InputError("--from", problem, "Give one of them.")
    maps = [path for path in paths if path not in (*configurations, *routes)]
    if configurations:
        (network,) = read_sumocfg(configurations[0]).files["net-file"]
        return [network, *maps], SumoDemand(folder, configurations[0], ())
    return maps, SumoDemand(folder, None, routes) if routes else None


def _root(path: Path) -> str:
    if not path.is_file() or not path.name.endswith(_SUFFIXES):
        return ""
    try:
        return xml.read_root_tag(path)
    except InputError:
        return ""  # the reader of its format reports it
