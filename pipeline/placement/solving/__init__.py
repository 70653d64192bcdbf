"""Plans and proofs: sums over cells that sensors raise together, rules, bounds, searches."""
