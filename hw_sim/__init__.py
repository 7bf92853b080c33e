"""A simulated rig: cameras, trigger board, wing and calibration sessions, with the truth kept apart."""
