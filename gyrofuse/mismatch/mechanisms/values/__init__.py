"""What a converter does to values."""
