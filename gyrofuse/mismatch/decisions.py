"""Decision thresholds that tests and mechanisms share."""

from __future__ import annotations

# p value: a departure of the simulation alone that is less surprising is taken for chance, as one in twenty is.
CHANCE = 0.05
# p value: an effect that is more surprising in the simulation alone is taken for its own: one null in 67
# has one in any of the fifteen tests.
CERTAIN = 1e-3
