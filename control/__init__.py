"""From the pose of what is felt to motion: the servo."""
