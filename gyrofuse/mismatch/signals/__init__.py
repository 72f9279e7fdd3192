"""Recording and simulation side by side, and what is derived from them."""
