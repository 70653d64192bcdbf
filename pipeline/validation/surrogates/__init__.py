"""Scores of a site that are compared with detection: the EGVS itself, and those that others have published."""
