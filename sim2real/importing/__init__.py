"""Data sets of real sensors, published or one's own, brought into the project's format."""
