"""Which noise model a recording asks for."""
