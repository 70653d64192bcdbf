"""Maps as SVG text: their frame, what lies under them, sites and fields on top."""
