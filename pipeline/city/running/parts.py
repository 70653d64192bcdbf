"""Some sites of a junction, scored: from the store, else scored here, and kept there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

from pipeline.core import code_digest, files
from pipeline.core.cost import measured
from pipeline.runs import stage_keys
from pipeline.runs.stages import Made
from pipeline.runs.store import Store
from pipeline.stages.shared import scored_parts
from pipeline.stages.shared.scored_parts import PART
from pipeline.stages.shared.site_scoring import ScoredSite, SiteScoring

KIND = "part"


def cut(count: int, parts: int) -> list[slice]:
    """``count`` sites in so many parts, as equal as can be."""
    ends = [count * number // parts for number in range(parts + 1)]
    return [slice(low, high) for low, high in pairwise(ends)]


def keep(scoring: SiteScoring, score_key: str, part: slice) -> int:
    """Score some sites unless the store has them; how many there are."""
    names = scoring.names[part]
    if names:
        with files.scratch() as folder:
            _bring(scoring, score_key, names, folder)
    return len(names)


def from_store(parts: int) -> Callable[[SiteScoring], Iterator[ScoredSite]]:
    """All sites of a junction that was cut in so many parts, for the score stage; what the store has lost is scored
    again."""

    def scored(scoring: SiteScoring) -> Iterator[ScoredSite]:
        score_key = stage_keys.inputs("score", scoring.work).key
        for part in cut(len(scoring.names), parts):
            if names := scoring.names[part]:
                with files.scratch() as folder:
                    yield from scored_parts.read(_bring(scoring, score_key, names, folder))

    return scored


def _bring(scoring: SiteScoring, score_key: str, names: tuple[str, ...], folder: Path) -> Path:
    """The file of some sites in a folder, from the store, where it is put if it is not there."""
    store, path = Store.default(), folder / PART
    program = code_digest.of(scored_parts.__name__).digest
    key = files.hash_of({"score": score_key, "sites": names, "program": program})
    if store.take(KIND, key, folder) is None:
        with store.maker(KIND, key):
            store.fetch(KIND, key)
            if store.take(KIND, key, folder) is None:  # nor has another one made it meanwhile
                with measured() as cost:
                    scored_parts.write(path, scoring.all_sites(only=names))
                store.put(KIND, key, folder, Made({PART: files.sha256_of(path)}, {}, {}, cost))
    return path
