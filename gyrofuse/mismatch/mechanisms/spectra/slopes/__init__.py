"""Noise that falls as a power of frequency."""
