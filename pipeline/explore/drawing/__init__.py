"""What the page draws: the world and what is laid over it, and how a mount is turned."""
