"""The steps of a run, each a verb of the command line: thin, from files to files."""
