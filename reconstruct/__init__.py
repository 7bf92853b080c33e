"""On the ground: from markers to the shape, twist and loads of a geometrically nonlinear beam."""
