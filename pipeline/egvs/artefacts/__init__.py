"""The files of a run folder: names, schemas, reading and writing."""
