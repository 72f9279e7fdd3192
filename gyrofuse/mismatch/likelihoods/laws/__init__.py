"""Laws of single samples: outliers, two levels, heavy tails, and a bent scale."""
