"""Typed views of a finished run: records and numbers."""
