"""Which sensor of an array no longer agrees with the others."""
