"""What moves through a network when nobody says who drives where: drawn trips, and routes that meet counts."""
