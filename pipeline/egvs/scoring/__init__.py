"""Scores of scans: EGVS, scores over vehicles, standard errors, blind spots."""
