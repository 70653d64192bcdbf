"""What a scenario may say: the models with every key, limit and default, and how a file is read and checked."""
