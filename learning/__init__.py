"""Pose estimation from tactile images: PoseNet, its training, hyperparameter search and evaluation."""
