"""Pages and sentences about fitted noise models."""
