"""File formats of recorded tracks."""
