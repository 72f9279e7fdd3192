"""Which findings stay: held-out scores, alternatives, backward elimination."""
