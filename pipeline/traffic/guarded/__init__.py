"""What stands between a user's files and SUMO: which options are taken over, what is copied, what SUMO may write."""
