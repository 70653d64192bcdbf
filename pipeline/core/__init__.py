"""What every other package builds on: errors, files, grids, parallel work, progress."""
