"""MATLAB files of version 4 to 7.3."""
