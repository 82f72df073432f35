"""Tactile image to pose: PoseNet, its training, its search, its evaluation."""
