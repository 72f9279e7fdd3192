"""Weights of sensors: the optimal ones, and those they are compared with."""
