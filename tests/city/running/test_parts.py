"""Parts of a score are read back to the last bit, and a file that is none is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egvs.city import tasks
from egvs.core.errors import InputError
from egvs.scoring.blindspots import SpotVisibility
from egvs.scoring.scorer import SiteScore
from egvs.scoring.target_scores import SiteTargetScores
from egvs.sensors.sites import Pose, ScannedSite
from egvs.stages.site_scoring import ScoredSite


def site(name: str, rng: np.random.Generator, *, full: bool) -> ScoredSite:
    """A site with numbers that have all their digits."""
    where = ScannedSite(name, "pole", Pose(*rng.random(6).tolist()), "VLP", 100, 90, 80)
    worth = SiteScore(
        float(rng.random()), float(rng.random()), rng.random(4) if full else None, {"coverage": rng.random(1)}
    )
    if not full:
        return ScoredSite(where, worth, None, None, None)
    worth = SiteScore(worth.egvs, worth.entropy_seen, worth.left_out, worth.shares, (worth, worth))
    seen = SpotVisibility(rng.integers(0, 9, 5), rng.random(5), np.array([np.nan, np.inf, 0.0, 0.1, -0.0]))
    targets = SiteTargetScores({"seen_well": np.array([np.nan, 0.1])}, ({"seen_well": float("nan")},), seen)
    index = {key: rng.integers(0, 9, 3).astype(np.int32) for key in ("ix", "iy", "iz")}
    return ScoredSite(where, worth, targets, None, {**index, "hits": rng.random(3)})


def same(a: object, b: object) -> bool:
    """Equal to the last bit, by the text of all that they hold."""
    with np.printoptions(threshold=10**6, floatmode="unique"):
        return repr(a) == repr(b)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    sites = [site("a", rng, full=True), site("b", rng, full=False), site("c", rng, full=True)]
    tasks.write_part(tmp_path / "part.npz", sites)
    found = list(tasks.read_part(tmp_path / "part.npz"))
    assert same([s.site for s in found], [s.site for s in sites])
    for there, here in zip(found, sites, strict=True):
        assert same((there.score, there.targets), (here.score, here.targets))
        assert same(there.visible, here.visible)
        if here.visible is not None and there.visible is not None:
            assert {k: v.dtype for k, v in there.visible.items()} == {k: v.dtype for k, v in here.visible.items()}


def test_the_same_sites_are_the_same_bytes(tmp_path: Path) -> None:
    for name in ("one.npz", "two.npz"):
        tasks.write_part(tmp_path / name, [site("a", np.random.default_rng(3), full=True)])
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()


@pytest.mark.parametrize("content", [b"", b"PK no archive", b"\x93NUMPY"])
def test_what_is_no_part_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "part.npz").write_bytes(content)
    with pytest.raises(InputError, match="is no part of a score"):
        list(tasks.read_part(tmp_path / "part.npz"))
