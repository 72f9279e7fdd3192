"""Tests of the values that samples take."""
