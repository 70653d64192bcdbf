"""Joint placement: plans of several LiDARs, with proven bounds on their quality."""
