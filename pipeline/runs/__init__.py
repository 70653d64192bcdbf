"""Runs of a whole scenario: the stages in order, and what is kept between runs."""
