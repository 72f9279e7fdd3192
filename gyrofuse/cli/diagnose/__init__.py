"""Command `diagnose`: effects that a simulation leaves out."""

from gyrofuse.cli.diagnose.command import diagnose

__all__ = ["diagnose"]
