"""Which poles together: the joint score of several LiDARs, plans within a demand, and what is proved of them."""
