"""On the aircraft: from trigger to MCAP segment, never blocking, every trigger accounted for."""
