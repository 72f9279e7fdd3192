"""Known paths on top of the noise."""
