"""Recordings: read from logs of any format, put together from several devices, or opened chunk by chunk."""
