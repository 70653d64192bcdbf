"""Effects on what a beam becomes before and at static surfaces."""
