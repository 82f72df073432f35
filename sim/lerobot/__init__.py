"""Data sets and servo runs in the format of LeRobot, and back."""
