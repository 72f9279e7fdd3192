"""A blind proof: recordings made from physics, sealed truths, and a judge who counts.

The generator knows nothing of the library that is judged: NumPy and SciPy only.

- `analog`, `mechanics`, `thermal`, `traps`, `converter`, `clock`: the physics, in continuous time where it is such.
- `likelihood`, `bench`: how large an effect is, in nats; what its oracle says of a recording.
- `shapes`, `spectral`, `marginal`, `strange`: the effects. `cases`: the kinds of cases, `make_case`.
- `seal`, `scoring`, `judge`, `ordinary_view`, `trial`: sealed truths, frozen answers, counts.

The size of an effect, in nats, is the divergence of the recording from the simulation that the analyst is given:

- a signal (tone, step, warm-up, clock): Whittle's divergence of its spectrum, 1/2 sum (r - 1 - log r) over frequencies
  and sensors, r = 1 + |m|^2/S; for the clock, of what no phase and amplitude of the line can explain;
- a signal whose shape a channel or few numbers give (temperature, acceleration, scale factor, sweep): half its whitened
  energy m' V^-1 m, summed over sensors;
- Gaussian noise of another spectrum (resonance, episodes, modulated noise): the same with r the ratio of the spectra;
- bursts of such noise at unknown times: the same less log of the number of ways to place them;
- of another spectrum over a broad band (flicker, low-pass, parameters), which only the comparison with a simulation of
  s times as many samples shows: 1/2 sum [(1 + s) log((r + s)/(1 + s)) - log r], which is the above for a model; for
  common mode the same with matrices;
- a wandering tone and a trap are taken for noise of their mean spectrum, which bounds their divergence from below; how
  far a trap is from such noise is simulated;
- spikes, a blurred lattice, Laplace noise: number of samples times the divergence of one sample, by quadrature or
  simulation;
- bare clipping, dead band, repeats: one altered sample is proof, and the nats are -log of the chance that none is:
  their expected number. Bare rounding alters every sample.
"""
