"""How files of other people are read: within bounds, and with one message for whatever is wrong with them."""
