"""Tactile servoing: from the estimated pose of the touched surface or edge to the motion of the sensor."""
