"""Finished files of floating car data: how long they are, and how large their vehicles."""
