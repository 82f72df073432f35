"""Errors of networks, in simulation and on real sensors."""
