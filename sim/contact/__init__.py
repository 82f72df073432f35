"""One contact of the soft tip with a stimulus: scene, stimuli, simulation, record."""
