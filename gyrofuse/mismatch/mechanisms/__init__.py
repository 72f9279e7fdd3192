"""Physics that a simulator leaves out: one class and one file each, under its equation."""
