"""What the simulation has and the recording does not."""
