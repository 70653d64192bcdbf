"""What a city run leaves: the junctions by what their best pole would see, all scores as one dataset, a page."""
