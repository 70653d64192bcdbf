"""Where on the road a site misses vehicles: by square metre, and by lane, approach and crossing in words."""
