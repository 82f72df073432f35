"""Work on several processes and machines: worker pools and folder locks."""
