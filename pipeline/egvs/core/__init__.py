"""Basics that every package uses: errors, files, grids, limits, plug-ins. Imports nothing of this program."""
