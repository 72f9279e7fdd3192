"""Several recordings of a device, or several groups of sensors of a board, in one diagnosis."""
