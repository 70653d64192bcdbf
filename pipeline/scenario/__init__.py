"""What a scenario may say: every key, its limit and its default; reading and checking."""
