"""Noise models: processes, their sums, arrays of them, and what a data sheet says of them."""
