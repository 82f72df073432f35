"""A real sensor's frames: cameras, videos, image folders, and their preprocessing."""
