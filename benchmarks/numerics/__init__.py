"""Count decisions of the program that differ from exact arithmetic.

``make numerics`` runs all checks at full length and prints one table: case, rule, how it was tested, number of cases,
number of cases excluded because a depth is within the stated margin of its bound, mismatches, worst figure.
"""
