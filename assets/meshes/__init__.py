"""Objects to follow, and the script that makes them."""
