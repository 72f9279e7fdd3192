"""The simulation with what it left out, and how it is saved."""
