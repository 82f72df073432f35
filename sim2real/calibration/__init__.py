"""A design and a rig fitted to real frames."""
