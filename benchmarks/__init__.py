"""Measurements behind the choice of settings and the pages of docs/: one `tactip bench` command and one module each."""
