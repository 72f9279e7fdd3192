"""Slow courses of the bias: steps, ramps, swings, warm-ups, and what follows a temperature."""
