"""Decision thresholds that tests and mechanisms share."""

from __future__ import annotations

# p value: a departure of the simulation alone that is less surprising is taken for chance, as one in twenty is.
CHANCE = 0.05
# p value: an effect that is more surprising in the simulation alone is taken for its own, and one of the recording is
# taken to be there before it is named. Fifteen tests of some dozens of nulls then hold one such error at most.
CERTAIN = 1e-3
# Nats by which a model may be behind another one and be as good: odds of 150 to 1.
NATS_AS_GOOD = 5.0
