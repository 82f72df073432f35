"""Errors and costs of the simulated contact."""
