"""Accuracy of the servo, and its viewers."""
