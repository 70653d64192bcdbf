"""Runs of a whole scenario: the stages in order, and the store of what they made."""
