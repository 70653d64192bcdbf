"""Point clouds with traffic: vehicle bodies before the empty scan, returns with noise, labels; and their files."""
