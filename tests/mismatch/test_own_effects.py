"""What a simulation has already is not found missing: of a repaired one by its names, of samples by looking."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.mechanisms.signals.g_sensitivity import GSensitivity
from gyrofuse.mismatch.mechanisms.slow.step import Step
from gyrofuse.mismatch.mechanisms.values.rounding.quantization import Quantization
from gyrofuse.mismatch.repair.inputs import prepared
from gyrofuse.mismatch.repair.reference_effects import with_own_effects
from gyrofuse.mismatch.repair.repaired_model import RepairedModel

N, P, RATE = 16384, 3, 100.0
NOISE = gf.ArrayModel.from_sensors([gf.WhiteNoise(1.0 + i / 10) + gf.AR1(0.99, 1e-3) for i in range(P)])
SIZE = torch.tensor([0.6, -0.8, 0.0], dtype=torch.float64)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def shaking() -> Tensor:
    return gf.AR1(0.9, 1e-2).simulate(N, batch=(1,), generator=generator(7))


def following(gain: float) -> Callable[[Tensor], Tensor]:
    return lambda x: x + gain * SIZE[:, None] * shaking()


def stepping(size: float) -> Callable[[Tensor], Tensor]:
    return lambda x: x + size * SIZE[:, None] * (torch.arange(N) >= 9000)


def rounded(x: Tensor) -> Tensor:
    late = torch.randn(x.shape, generator=generator(8), dtype=torch.float64)
    return 1.2 * torch.round(x / 1.2) + 0.45 * late


def dead(x: Tensor) -> Tensor:
    return torch.where(x.abs() < 2e-3, 0.0, x)


def recording(x: Tensor) -> gf.Recording:
    return gf.Recording(x, rate=RATE, unit="deg/s", channels={"acceleration": shaking()})


def drawn(seed: int, *, records: int = 1) -> Tensor:
    noise = NOISE.simulate(N, batch=(records,), generator=generator(seed))
    return noise.movedim(0, 1).flatten(1)


def noise_like(change: Callable[[Tensor], Tensor]) -> gf.ArrayModel:
    """Noise as strong as what hidden rounding leaves."""
    before, after = drawn(90), change(drawn(90))
    stronger = (after.diff().var(-1) / before.diff().var(-1)).tolist()
    sensors = [gf.WhiteNoise(f * (1 + i / 10)) + gf.AR1(0.99, 1e-3) for i, f in enumerate(stronger)]
    return gf.ArrayModel.from_sensors(sensors)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("change", "mechanism"),
    [(following(3.0), "g_sensitivity"), (stepping(2.0), "step"), (dead, "quantization"), (rounded, "quantization")],
)
def test_a_simulation_that_was_repaired_is_not_repaired_again(change: Callable[[Tensor], Tensor], mechanism: str):
    given = recording(change(drawn(1)))
    simulation = noise_like(change) if change is rounded else NOISE
    first = gf.diagnose(given, simulation)
    assert mechanism in {f.mechanism for f in first.findings}
    again = gf.diagnose(given, first.model)
    assert not again.mismatch
    assert [type(e) for e in again.model.effects] == [type(e) for e in first.model.effects]
    torch.testing.assert_close(again.correct(given).signal, first.correct(given).signal)
    assert again.benefit("long").factor == pytest.approx(first.benefit("long").factor, rel=1e-6)
    samples = first.model.simulate(N, generator=generator(3))
    assert not gf.diagnose(given, recording(samples)).mismatch


@pytest.mark.statistical
@pytest.mark.parametrize(("change", "kind"), [(following, GSensitivity), (stepping, Step)])
def test_more_than_the_simulation_has_is_the_difference(change: Callable[[float], Callable[[Tensor], Tensor]], kind):
    given = recording(change(5.0)(drawn(11)))
    found = gf.diagnose(given, recording(change(2.0)(drawn(12))))
    own, missing = (effect for effect in found.model.effects if isinstance(effect, kind))
    (finding,) = found.findings
    assert finding.effect is missing
    sizes = [effect.amplitudes.flatten()[:2] for effect in (own, missing)]
    torch.testing.assert_close(sizes[0] / SIZE[:2], torch.full((2,), 2.0, dtype=torch.float64), rtol=0, atol=0.5)
    torch.testing.assert_close(sizes[1] / SIZE[:2], torch.full((2,), 3.0, dtype=torch.float64), rtol=0, atol=0.7)
    for name, entry in finding.parameters.items():
        if name.startswith(("gain", "size")):
            assert entry.low < entry.value < entry.high


@pytest.mark.statistical
@pytest.mark.parametrize("change", [following(0.3), stepping(2.0)])
def test_a_simulation_without_the_effect_is_not_said_to_have_it(change: Callable[[Tensor], Tensor], draws):
    """Chance gives any number some gain in a simulation that knows nothing of it."""
    said = 0
    wandering = gf.WhiteNoise(1.0) + gf.RandomWalk(1e-4)
    for seed in range(draws(10, 30)):
        g = generator(500 + seed)
        given, simulation = (wandering.simulate(N, batch=(P,), generator=g) for _ in range(2))
        comparison = prepared(recording(change(given)), recording(simulation), None, g)
        said += bool(with_own_effects(comparison, recording(simulation), 5e-4, g)[1])
    assert said == 0


@pytest.mark.statistical
def test_a_simulation_with_the_effect_is_seldom_doubted(draws):
    false_alarms = 0
    for seed in range(draws(5, 20)):
        given = recording(following(3.0)(drawn(100 + seed)))
        simulation = torch.cat([following(3.0)(x) for x in drawn(200 + seed, records=2).split(N, -1)], -1)
        false_alarms += gf.diagnose(given, recording_of_two(simulation)).mismatch
    assert false_alarms <= draws(1, 2)  # at 1 %: more once in a thousand times


@pytest.mark.statistical
def test_a_model_of_samples_is_no_surer_than_they_were(draws):
    false_alarms = 0
    for seed in range(draws(5, 20)):
        given = recording(following(3.0)(drawn(300 + seed)))
        first = gf.diagnose(given, recording_of_two(drawn(400 + seed)))
        assert first.model.noise_samples == N
        false_alarms += gf.diagnose(given, first.model).mismatch
    assert false_alarms <= draws(1, 2)  # at 1 %: more once in a thousand times


def recording_of_two(x: Tensor) -> gf.Recording:
    return gf.Recording(x, rate=RATE, unit="deg/s")


def test_one_that_is_repaired_has_to_fit_the_recording():
    model = RepairedModel(NOISE, gf.diagnose(recording(drawn(1)), NOISE).model.info)
    follows = model + GSensitivity("acceleration", SIZE[:, None])
    bare = gf.Recording(drawn(1), rate=RATE, unit="deg/s")
    with pytest.raises(ValueError, match="`channels`: expected acceleration, which the simulation follows, got none"):
        gf.diagnose(bare, follows)
    with pytest.raises(ValueError, match="`rate`: expected that of the repaired simulation, 100 Hz, got 50 Hz"):
        gf.diagnose(drawn(1), model, rate=50.0)
    with pytest.raises(ValueError, match="`simulation`: expected 2 sensors as in the recording, got 3"):
        gf.diagnose(drawn(1)[:2], model, rate=RATE)


def test_samples_are_described_with_what_their_sensors_share_and_with_their_lines():
    r = torch.tensor([[1.0, 0.6, 0.0], [0.6, 1.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    gains = torch.tensor([0.3, -0.2, 0.0], dtype=torch.float64)
    alone = torch.eye(3, dtype=torch.float64)
    simulator = gf.ArrayModel([(gf.WhiteNoise(1.0), r), (gf.AR1(0.99, 4e-3), alone), (gf.Sinusoid(1.0, 0.7), gains)])
    given, samples = (simulator.simulate(n, generator=generator(n)) for n in (N, 4 * N))
    model = gf.diagnose(given, samples, rate=RATE).model
    assert not gf.diagnose(given, model, rate=RATE).mismatch
    expected, found = (m.wavelet_cross_covariance(8) for m in (simulator, model.noise))
    size = expected.diagonal(dim1=-2, dim2=-1).rsqrt()
    unit = size[:, :, None] * size[:, None, :]
    torch.testing.assert_close(found * unit, expected * unit, rtol=0, atol=0.15)
    (line,) = (matrix for process, matrix in model.noise.components if isinstance(process, gf.Sinusoid))
    torch.testing.assert_close(line * line[0].sign(), gains, rtol=0, atol=0.03)


def test_hidden_rounding_over_a_few_steps_has_the_law_of_rounding_and_later_noise():
    # Straight from physics: what is rounded, and what comes on top.
    step, sd, later = 1.0, 0.5, 0.44
    g = generator(21)
    n = 2**18
    clean, late = (torch.randn(n, generator=g, dtype=torch.float64) for _ in range(2))
    physical = torch.round(sd * clean) + later * late
    plain = float(physical.std()) * torch.randn(1, n, generator=g, dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    made = Quantization(step * one, 0 * one, later * one, plain.mean(-1)).apply(plain, None, g)[0]  # type: ignore[arg-type]
    for u in torch.linspace(0.5, 7.0, 27, dtype=torch.float64):
        expected = torch.exp(1j * u * physical).mean()
        assert abs(torch.exp(1j * u * made).mean() - expected) < 5 / n**0.5, u
    assert float(torch.corrcoef(torch.stack([plain[0], made]))[0, 1]) > 0.99


@pytest.mark.statistical
@pytest.mark.parametrize("loud", [False, True])
def test_what_happened_once_counts_where_the_recording_has_it(loud: bool):
    """A step or an episode of one recording is not missed in another."""
    at = torch.arange(N)
    inside = (at >= 3000) & (at < 6000)

    def happened(x: Tensor) -> Tensor:
        return torch.where(inside, 1.3 * x, x) if loud else stepping(0.6)(x)

    name = "variance_change" if loud else "step"
    first = gf.diagnose(recording(happened(drawn(31))), NOISE)
    assert [finding.mechanism for finding in first.findings] == [name]
    again = gf.diagnose(recording(happened(drawn(31))), first.model)
    assert not again.mismatch
    assert [effect.name for effect in again.model.effects] == [name]
    elsewhere = gf.diagnose(recording(drawn(33)), first.model)
    assert not elsewhere.mismatch
    assert elsewhere.model.effects == ()
