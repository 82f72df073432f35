"""The learned tip: deformation of the skin and forces of a contact, predicted by networks taught on simulated contacts."""
