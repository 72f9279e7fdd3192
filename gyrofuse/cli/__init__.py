"""The command line."""

from gyrofuse.cli.app import main as main
