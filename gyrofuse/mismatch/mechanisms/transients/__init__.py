"""Signals that come and go, or whose phase goes its own way: taken off the recording, drawn anew elsewhere."""
