"""Which sensors together: plans of several LiDARs and proofs of how good they are."""
