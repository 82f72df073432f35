"""Visualization: scene geometry, browser pages, windows, videos and figures."""
