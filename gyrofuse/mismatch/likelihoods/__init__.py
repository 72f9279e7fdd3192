"""Observation models: what a mechanism makes of a recording, as log likelihoods, scores and information."""
