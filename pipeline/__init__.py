"""egvs: which pole, what height, how many roadside LiDARs?"""

__version__ = "0.1.0"
