"""The report's sentences, on rankings made by hand."""

from __future__ import annotations

from pipeline.report import wording
from pipeline.report.ranking import Ranking, ScoredSite


def ranking(*rows: tuple[str, float, int, float, float]) -> Ranking:
    """From (site, score, rank, entropy seen, chance to beat the next), best first."""
    sites = tuple(
        ScoredSite(site, 0.0, 0.0, 3.0, egvs, rank, site, 0.0, 0.0, 0.0, "s", 200.0, 1, 1, seen, 1.0, beats)
        for site, egvs, rank, seen, beats in rows
    )
    return Ranking(sites, tuple(site for site in sites if site.rank == 1), ())


def test_the_one_beside_the_next_says_whether_the_first_can_be_told_from_it() -> None:
    """Two that share the first place cannot beat each other; whether they lead is another matter."""
    ahead = ranking(("a", 100.0, 1, 0.5, 0.5), ("b", 100.0, 1, 0.6, 0.99), ("c", 80.0, 3, 0.4, 1.0))
    assert wording.lead(ahead) == "They lead c, the next, by 20.0% of their score."
    near = ranking(("a", 100.0, 1, 0.5, 0.5), ("b", 100.0, 1, 0.6, 0.7), ("c", 98.0, 3, 0.4, 1.0))
    assert wording.lead(near).endswith("by 2.0% of their score. With this much traffic they cannot be told apart.")
    alone = ranking(("a", 100.0, 1, 0.5, 0.7), ("c", 98.0, 2, 0.4, 1.0))
    assert wording.lead(alone).endswith("With this much traffic they cannot be told apart.")


def test_the_score_is_to_be_trusted_only_where_it_says_something_else() -> None:
    """Of two with the same score, one that sees more contradicts nothing."""
    tied = ranking(("a", 100.0, 1, 0.5, 0.5), ("b", 100.0, 1, 0.6, 0.99), ("c", 80.0, 3, 0.4, 1.0))
    assert wording.which_to_trust(tied) == "b also sees most of the traffic’s uncertainty, 60.0%."
    other = ranking(("a", 100.0, 1, 0.5, 0.99), ("c", 80.0, 2, 0.7, 1.0))
    assert wording.which_to_trust(other).startswith(
        "c, rank 2, sees more of the traffic’s uncertainty (70.0% against 50.0%), but with fewer beams on it: trust"
    )
    agree = ranking(("a", 100.0, 1, 0.7, 0.99), ("c", 80.0, 2, 0.5, 1.0))
    assert wording.which_to_trust(agree) == "It also sees most of the traffic’s uncertainty, 70.0%."
