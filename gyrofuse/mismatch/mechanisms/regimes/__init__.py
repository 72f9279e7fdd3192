"""Noise that is another at some times."""
