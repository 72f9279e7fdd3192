"""A blind proof: recordings made from physics, sealed truths, and a judge who counts.

The generator knows nothing of the library that is judged: NumPy and SciPy only.

- `analog`, `mechanics`, `thermal`, `traps`, `converter`, `clock`: the physics, in continuous time where it is such.
- `likelihood`, `bench`: how large an effect is, in nats; what its oracle says of a recording.
- `shapes`, `spectral`, `marginal`, `strange`: the effects. `cases`: the kinds of cases, `make_case`.
- `seal`, `scoring`, `judge`, `ordinary_view`, `trial`: sealed truths, frozen answers, counts.

The size of an effect, in nats, is the expected log likelihood ratio of the known effect:

- a known signal m (tone, step, temperature, warm-up, acceleration, scale factor, clock): 1/2 sum over sensors of
  m' V^-1 m; for the clock, of what no phase and amplitude of the line can explain;
- Gaussian noise of another spectrum (resonance, flicker, low-pass, parameters, common mode, episodes, modulated noise):
  1/2 sum (r - 1 - log r), for common mode with matrices; a wandering tone is taken for noise of its mean spectrum,
  which bounds its divergence from below;
- spikes, a blurred lattice, Laplace noise: number of samples times the divergence of one sample, by quadrature or
  simulation; a trap: by simulation of the forward algorithm;
- bare clipping, dead band, repeats: one altered sample is proof, and the nats are -log of the chance that none is:
  their expected number. Bare rounding alters every sample.
"""
