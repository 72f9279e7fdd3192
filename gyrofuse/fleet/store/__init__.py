"""The table that a fleet fills, whatever interrupts it."""
