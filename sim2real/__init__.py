"""Everything that touches a real sensor: frames, import, calibration, transfer."""
