"""Levels of the J test, that a model explains the wavelet variances that it was fitted to."""

# P value below which a model is in doubt, and a report says where it is off: one complete model in twenty is.
DOUBTED = 0.05
# P value below which a model is rejected, as incomplete: one complete model in a hundred is. A summary counts these.
REJECTED = 0.01
# P value below which a model is clearly rejected: one complete model in a thousand is. Its intervals are then the wider
# ones, symmetric or by profile, as neither is right for an incomplete model. No candidate of a ranking fits where all
# are clearly rejected: the level is strict, as the largest p value of several candidates is judged.
CLEARLY_REJECTED = 1e-3
