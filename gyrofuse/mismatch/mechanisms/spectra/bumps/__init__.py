"""Bumps of a spectrum: resonances, and tones whose frequency wanders."""
