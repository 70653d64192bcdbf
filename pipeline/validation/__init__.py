"""Validation: what would a detector find from each site, and which score foretells it?

Parts, each a package of its own: point clouds with traffic (``clouds``), detectors (``detectors``), average precision
(``metrics``), scores that are compared (``surrogates``), correlation and its intervals (``statistics``). Nothing of a
run imports this package.
"""
