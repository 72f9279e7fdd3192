"""What two packages or more need, without a word of the domain."""

from importlib.metadata import version

__version__ = version("gyrofuse")
