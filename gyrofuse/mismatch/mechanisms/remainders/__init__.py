"""What is left of a difference that has no name."""
