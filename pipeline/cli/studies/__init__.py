"""Tables of studies: many runs of one scenario, or several runs side by side."""
