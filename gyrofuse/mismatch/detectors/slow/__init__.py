"""Tests of what is slow, and of what follows a channel."""
