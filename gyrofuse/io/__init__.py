"""Recordings: read from logs of any format, put together from several devices, or opened chunk by chunk."""

from gyrofuse.io.chunked import shard_bounds

__all__ = ["shard_bounds"]
