"""Effects on who moves, and on the ground."""
