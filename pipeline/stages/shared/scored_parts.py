"""Files of sites that were scored, for who puts the parts of a scenario together: ``part.npz``.

Numbers stand in one array for each type; a JSON text says which of them belong where. So a part is read back to the
last bit, and reading one runs nothing that stands in it.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.scoring.blindspots.spots import SiteSeen
from pipeline.scoring.scorer import SiteScore
from pipeline.sensing.sites import ScannedSite
from pipeline.stages.shared.site_scoring import ScoredSite
from pipeline.stages.shared.target_scores import SiteTargets

PART = "part.npz"

_KINDS = ("float64", "int64", "int32")
_ABOUT = "about"


def write(path: Path, sites: Iterable[ScoredSite]) -> None:
    """Write some sites (none of them audited), in order; no more than one is held beside its numbers."""
    pool = _Pool()
    about = [pool.of_site(site) for site in sites]
    with files.aside(path) as partial, partial.open("wb") as file:
        text = np.frombuffer(json.dumps(about).encode("utf-8"), dtype=np.uint8)
        np.savez(file, allow_pickle=False, **{_ABOUT: text}, **pool.joined())


def read(path: Path) -> Iterator[ScoredSite]:
    """The sites of a file, one by one; InputError where it is none."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            about = json.loads(stored[_ABOUT].tobytes())
            find = _of({kind: stored[kind] for kind in _KINDS})
        for value in about:
            yield _site(value, find, path)
    except (OSError, EOFError, ValueError, LookupError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(path, f"is no part of a score ({error})", "remove it, and run again") from None


class _Pool:
    """Arrays, one after another, by their type."""

    def __init__(self) -> None:
        self._numbers = {kind: bytearray() for kind in _KINDS}

    def add(self, array: NDArray[Any] | None) -> list[Any] | None:
        """Where an array (n,) stands; None for none."""
        if array is None:
            return None
        kind = str(array.dtype)
        start = len(self._numbers[kind]) // array.itemsize
        self._numbers[kind] += array.tobytes()
        return [kind, start, len(array)]

    def many(self, arrays: Mapping[str, NDArray[Any]] | None) -> dict[str, Any] | None:
        """The same by name."""
        return None if arrays is None else {name: self.add(array) for name, array in arrays.items()}

    def joined(self) -> dict[str, NDArray[Any]]:
        """All of them, one array a type."""
        return {kind: np.frombuffer(numbers, dtype=kind) for kind, numbers in self._numbers.items()}

    def of_site(self, its: ScoredSite) -> dict[str, Any]:
        """A site, its arrays by where they stand."""
        return {
            "site": its.site.to_json(),
            "score": self._of_score(its.score),
            "targets": None if its.targets is None else self._of_targets(its.targets),
            "visible": self.many(its.visible),
        }

    def _of_score(self, its: SiteScore) -> dict[str, Any]:
        return {
            "worth": [its.egvs, its.entropy_seen],
            "left_out": self.add(its.left_out),
            "shares": self.many(its.shares),
            "by_period": [self._of_score(period) for period in its.by_period],
        }

    def _of_targets(self, its: SiteTargets) -> dict[str, Any]:
        missed = its.missed
        return {
            "scores": self.many(its.scores),
            "by_period": [dict(period) for period in its.by_period],
            "missed": None if missed is None else [self.add(a) for a in (missed.seen, missed.share, missed.se)],
        }


Find = Callable[[Any], Any]
"""The array that stands somewhere; None for None."""


def _of(arrays: Mapping[str, NDArray[Any]]) -> Find:
    def find(where: Any) -> Any:
        if where is None:
            return None
        kind, start, length = where
        found = arrays[kind][start : start + length]
        if len(found) != length:
            raise ValueError("numbers are missing")
        return found.copy()  # a view would hold the whole file's numbers for as long as one site's score is known

    return find


def _site(value: dict[str, Any], find: Find, path: Path) -> ScoredSite:
    targets, visible = value["targets"], value["visible"]
    return ScoredSite(
        ScannedSite.from_json(value["site"], path),
        _score(value["score"], find),
        None if targets is None else _targets(targets, find),
        None,
        None if visible is None else _many(visible, find),
    )


def _score(value: dict[str, Any], find: Find) -> SiteScore:
    egvs, seen = (float(number) for number in value["worth"])
    by_period = tuple(_score(period, find) for period in value["by_period"])
    return SiteScore(egvs, seen, find(value["left_out"]), _many(value["shares"], find), by_period)


def _targets(value: dict[str, Any], find: Find) -> SiteTargets:
    missed = value["missed"]
    by_period = tuple({name: float(number) for name, number in period.items()} for period in value["by_period"])
    return SiteTargets(
        _many(value["scores"], find), by_period, None if missed is None else SiteSeen(*(find(its) for its in missed))
    )


def _many(value: dict[str, Any], find: Find) -> dict[str, NDArray[Any]]:
    return {name: find(where) for name, where in value.items()}
