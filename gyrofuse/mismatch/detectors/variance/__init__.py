"""Tests of outliers, jumps, and of variance that changes."""
