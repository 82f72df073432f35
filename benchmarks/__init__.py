"""Measurements that choose the settings and stand in the documents. Each is one command; results are JSON and Markdown."""
