"""The verbs that ask whether a score foretells detection: each parses, calls, prints; nothing else."""

from __future__ import annotations


def scores() -> None:
    """Print the scores that validation compares: formula, which way is better, source."""
    from pipeline.cli import validation_tables
    from pipeline.validation.surrogates import registry

    validation_tables.print_scores(registry.catalogue())


VERBS = (scores,)
"""In the order of the help."""
