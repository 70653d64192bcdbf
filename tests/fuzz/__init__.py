"""A mutation fuzzer of every kind of file that the program reads, and kills at any moment: ``python -m tests.fuzz``."""
