"""Lines that move through the spectrum: along straight tracks, along any path, and as a channel says."""
