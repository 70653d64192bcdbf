"""What is seen of each vehicle of recorded traffic from a site, and scores that are made of it."""
