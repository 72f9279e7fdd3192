"""`python -m gyrofuse`."""

from gyrofuse.cli import main

main()
