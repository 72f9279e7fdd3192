"""Tests of whether a recording and a simulation differ: one file, one statistic and its law."""
