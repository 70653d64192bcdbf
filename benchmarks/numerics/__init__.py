"""How often does the pipeline decide otherwise than exact arithmetic does?

``make numerics`` runs every hunt at full length and prints one table: case, rule, how it was tested, how many cases,
how many were excluded because a depth lies within the stated margin of its bound, mismatches, worst figure.
"""
