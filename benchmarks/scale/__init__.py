"""Rates, memory and scaling."""
