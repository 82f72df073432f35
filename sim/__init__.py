"""Simulation of the sensor and its world: contacts, data sets, robot, recordings. Metres and radians."""
