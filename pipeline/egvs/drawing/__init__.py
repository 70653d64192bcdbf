"""Drawings as SVG: maps, figures, colours."""
