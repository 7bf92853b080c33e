"""On the ground: from recorded frames to 3-D markers with covariances."""
