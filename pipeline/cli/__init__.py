"""The command line: what the user types, and the tables that answer."""
