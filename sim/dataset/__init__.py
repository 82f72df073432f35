"""Data sets of simulated contacts: format, sampling, generation, verification."""
