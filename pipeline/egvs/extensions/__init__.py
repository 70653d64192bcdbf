"""Extensions: parts of the program that can be taken away; the core finds them through entry points."""
