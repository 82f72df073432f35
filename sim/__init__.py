"""The world of the sensor: frames, stimuli, contacts, data sets. Metres and radians."""
