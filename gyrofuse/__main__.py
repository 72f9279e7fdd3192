"""`python -m gyrofuse`."""

from gyrofuse.cli.app import main

main()
