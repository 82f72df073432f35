"""Accuracy of the servo, and the cost of viewing its recordings."""
