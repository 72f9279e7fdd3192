"""Pages and sentences about a fused array."""
