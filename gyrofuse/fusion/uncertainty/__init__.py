"""How far weights, and what they gain, may be off."""
