"""What converters of many bits, counters of angles and drivers do to values, on grids far finer than the noise."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from mismatch_draws import SCENE
from scipy import fft, signal, stats
from torch import Tensor

from gyrofuse.mismatch.detectors.lines.ring_cells import in_another_order
from gyrofuse.mismatch.detectors.lines.ring_downs import ring_down_p_value
from gyrofuse.mismatch.detectors.moving.chirps import decorrelated_record
from gyrofuse.mismatch.detectors.moving.moving_lines import moving_line
from gyrofuse.mismatch.detectors.spectra.delays import sensor_delays
from gyrofuse.mismatch.detectors.values.angle_counts import angle_counts
from gyrofuse.mismatch.detectors.values.lattices import exact_lattices, simulated_lattices
from gyrofuse.mismatch.detectors.values.median_windows import median_windows
from gyrofuse.mismatch.detectors.values.missing_codes import missing_codes
from gyrofuse.mismatch.detectors.values.quantisation_grid import missing_lattices
from gyrofuse.mismatch.detectors.values.sensor_gains import sensor_gains
from gyrofuse.mismatch.detectors.values.values import end_stops, repeats
from gyrofuse.mismatch.detectors.variance.pulses import pulse_p_value
from gyrofuse.mismatch.mechanisms.regimes.gradual_change import GradualChange
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.prediction_errors import left_out

N, P, FINE = 16_384, 3, 0.0166  # a step too fine to matter beside noise of sd one


def normal(seed: int, sensors: int = P, n: int = N) -> Tensor:
    return torch.randn(sensors, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def on_grid(x: Tensor, step: float = FINE) -> Tensor:
    return step * torch.round(x / step)


def compared(recording: Tensor, simulation: Tensor) -> Comparison:
    return Comparison.of(SCENE, recording, simulation[None])


def test_a_grid_too_fine_for_the_simulation_is_its_own_where_the_recording_is_quieter() -> None:
    quiet = normal(1) * torch.tensor([[1.0], [0.3], [1.0]], dtype=torch.float64)
    comparison = compared(on_grid(quiet), on_grid(normal(2)))
    assert exact_lattices(comparison.reference) == (None, None, None)
    lattices = simulated_lattices(comparison)
    assert lattices[1] is not None
    assert lattices[1].step == pytest.approx(FINE, rel=1e-6)
    assert not missing_lattices(comparison, 0.01).lattices
    assert 1 in missing_lattices(compared(on_grid(quiet), normal(2)), 0.01).lattices


def test_what_arithmetic_leaves_of_a_grid_is_one() -> None:
    """Differences of sums of steps are steps up to the last digits."""
    counts = (torch.round(normal(3).cumsum(-1) / 0.8) * 0.8).diff(dim=-1)
    assert len(counts[0].unique()) > len((counts[0] / 0.8).round().unique())
    lattices = exact_lattices(compared(counts, normal(4)).observed)
    assert [own is not None and abs(own.step - 0.8) < 1e-9 for own in lattices] == [True] * P


@pytest.mark.parametrize("step", [0.8, 2.0, 4.0])
def test_counts_of_an_angle_are_no_rounded_rate(step: float) -> None:
    counts = torch.round((normal(5, n=N + 1) / step).cumsum(-1)).diff(dim=-1) * step
    assert set(angle_counts(compared(counts, normal(6)), 1e-3)) == {0, 1, 2}
    assert not angle_counts(compared(on_grid(normal(5), step), normal(6)), 1e-3)


def test_dither_is_no_count_of_an_angle() -> None:
    dither = torch.rand(2, P, N, generator=torch.Generator().manual_seed(7), dtype=torch.float64).sum(0) - 1
    assert not angle_counts(compared(on_grid(normal(7) + 0.7 * dither, 0.7), normal(8)), 1e-3)


@pytest.mark.parametrize("bit", [3, 6, 7])
def test_a_high_bit_that_is_stuck_is_seen_on_a_grid_far_below_the_noise(bit: int) -> None:
    step = 1 / 100
    codes = torch.round(normal(9) / step).long() + 2**20
    stuck = (torch.where(torch.tensor([[True], [False], [False]]), codes | 2**bit, codes) - 2**20).double() * step
    simulation = on_grid(normal(10), step)
    found = missing_codes(compared(stuck, simulation))
    assert set(found) == {0}
    assert found[0].bit == bit
    assert found[0].p_value < 1e-100
    assert not missing_codes(compared((codes - 2**20).double() * step, simulation))
    # Nor does what stays for long on either of two levels lack codes.
    levels = torch.where(torch.arange(N) // 2000 % 2 == 0, 0.0, 2.0 ** (bit + 1) * step)
    assert not missing_codes(compared(on_grid(normal(11) + levels, step), simulation))


def test_values_at_an_edge_are_as_many_as_those_beside_it() -> None:
    """A stuck bit ends values where the next code is missing: nothing is cut off there."""
    step = 1 / 100
    codes = torch.round(normal(12) / step).long() + 2**20
    ends = end_stops(compared(((codes | 64) - 2**20).double() * step, on_grid(normal(13), step)))
    assert min(end.p_value for end in ends) > 1e-3
    cut = end_stops(compared(on_grid(normal(12).clamp(max=2.0), step), on_grid(normal(13), step)))
    assert max(end.p_value for end in cut if end.sign > 0) < 1e-12


@pytest.mark.parametrize("window", [3, 5])
def test_a_running_median_of_values_on_a_fine_grid_is_seen(window: int) -> None:
    x = on_grid(normal(14))
    x[1] = torch.from_numpy(signal.medfilt(x[1].numpy(), window))
    assert median_windows(compared(x, on_grid(normal(15)))).within(1e-6) == (1,)
    smooth = on_grid(torch.from_numpy(signal.lfilter([0.3], [1, -0.7], normal(16).numpy())))
    assert median_windows(compared(smooth, on_grid(normal(15)))).within(1e-3) == ()
    cut = on_grid(normal(14).clamp(-0.8, 0.9))  # the ends come back all the time
    assert median_windows(compared(cut, on_grid(normal(15)))).within(1e-3) == ()


def test_rows_of_repeats_are_seen_where_the_simulation_repeats_as_well() -> None:
    x, step = on_grid(normal(17), 0.05), 0.05
    for first in (2000, 7000, 12_000):
        x[2, first : first + 15] = x[2, first - 1]
    p_values = repeats(compared(x, on_grid(normal(18), step))).p_values
    assert float(p_values[2]) < 1e-6
    assert float(p_values[:2].min()) > 0.01


def test_a_filter_of_many_taps_turns_no_sensor_round() -> None:
    """What sensors share comes so much later that at zero lag it has the other sign."""
    shared = torch.from_numpy(signal.lfilter([0.05], [1, -0.95], 4 * normal(19, 1).numpy())) * torch.ones(P, 1)
    taps = signal.firwin(41, 0.2)
    x = normal(20) * 0.5 + shared
    simulation = normal(21) * 0.5 + torch.from_numpy(signal.lfilter([0.05], [1, -0.95], 4 * normal(22, 1).numpy()))
    late = x.clone()
    late[1] = torch.from_numpy(signal.lfilter(taps, [1.0], x[1].numpy()))
    found = sensor_gains(compared(late, simulation))
    assert found is None or float(found.factor.min()) > 0
    turned = x.clone()
    turned[1] *= -1
    found = sensor_gains(compared(turned, simulation))
    assert found is not None
    assert found.factor.sign().tolist() == [1.0, -1.0, 1.0]


@pytest.mark.parametrize("seed", range(40, 52))
def test_sensors_that_share_nothing_have_no_sign(seed: int) -> None:
    """Beside others that do: what their cross-spectra show is chance, however many bands there are of it."""
    gain = torch.tensor([0.8, 0.7, 0.6, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)[:, None]
    info = replace(SCENE, sensors=tuple("12345678"))
    both = (normal(one, 8, 8192) + gain * normal(one + 100, 1, 8192) for one in (seed, seed + 1000))
    recording, simulation = both
    comparison = Comparison.of(info, recording, simulation[None])
    found = sensor_gains(comparison)
    assert found is None or float(found.factor.min()) > 0
    delays = sensor_delays(comparison)
    assert delays is None or bool((delays.delay.abs() < 4 * delays.sd).all())


def test_two_groups_that_share_noise_have_delays_of_their_own() -> None:
    """What lies between the groups is not known, nor is any delay of a sensor that shares nothing."""
    group = torch.zeros(7, 2, dtype=torch.float64)
    group[:3, 0], group[3:6, 1] = 1.0, 1.0

    def drawn(seed: int, late: int) -> Tensor:
        shared = 1.5 * normal(seed + 100, 2, 8192 + 8)
        x = normal(seed, 7, 8192) + group @ shared[:, 8:]
        x[4] += shared[1, 8 - late : 8192 + 8 - late] - shared[1, 8:]
        return x

    info = replace(SCENE, sensors=tuple("1234567"))
    found = sensor_delays(Comparison.of(info, drawn(60, 3), drawn(61, 0)[None]))
    assert found is not None
    assert found.delay.round().tolist() == [0, 0, 0, 0, 3, 0, 0]


def test_values_of_few_steps_have_ends_as_well() -> None:
    ends = end_stops(compared(on_grid(normal(62), 4.0), on_grid(normal(63), 4.0)))
    assert min(end.p_value for end in ends) > 1e-3


def test_a_level_that_goes_up_and_down_a_few_times_is_a_course() -> None:
    t = torch.arange(N) / N
    wave = (0.5 * torch.sin(2 * math.pi * 3 * t)).exp()
    found = GradualChange.detect_and_fit(compared(wave * normal(23), normal(24)), 1e-3)
    assert found is not None
    assert "up and down" in found.sentence
    assert found.sensors == (0, 1, 2)
    ratio = found.effect.course(N, SCENE).variance[0] / wave.square()
    assert float(ratio.log().std()) < 0.15
    fast = (0.5 * torch.sin(2 * math.pi * 300 * t)).exp()
    assert GradualChange.detect_and_fit(compared(fast * normal(23), normal(24)), 1e-3) is None


def heavy_tailed(seed: int) -> Tensor:
    """One sensor of three with Student's t of 2.5 degrees of freedom."""
    x = normal(seed)
    uniform = torch.special.ndtr(x[1]).clamp(1e-12, 1 - 1e-12)
    x[1] = torch.from_numpy(stats.t.ppf(uniform.numpy(), 2.5))
    return x


@pytest.mark.parametrize("seed", [25, 26, 27])
def test_heavy_tails_neither_push_nor_ring(seed: int) -> None:
    comparison = compared(heavy_tailed(seed), normal(seed + 10))
    assert pulse_p_value(comparison) > 1e-3
    assert ring_down_p_value(comparison) > 1e-3


def test_disorder_is_the_same_for_all_samples_and_changes_none() -> None:
    x = normal(28)
    assert torch.equal(in_another_order(x).sort(-1).values, x.sort(-1).values)
    assert torch.equal(in_another_order(x), in_another_order(x))


def test_slow_noise_is_no_line_and_leaves_what_is_slow_white() -> None:
    """Its steepest ordinates stand out of their band; what is beside them is no skirt of theirs."""
    slow = torch.from_numpy(signal.lfilter([0.003], [1, -0.99995], normal(29, n=65_536).numpy()))
    side = compared(normal(30, n=65_536) + 40 * slow, normal(31, n=65_536)).observed
    power = torch.from_numpy(fft.dct(left_out(side).white[0].numpy(), norm="ortho")).square()
    assert float(power[:, 100:800].mean(-1).min()) > 0.5


def test_a_large_outlier_leaves_no_slow_pulse() -> None:
    x = torch.from_numpy(signal.lfilter([0.24 * math.sqrt(1 - 0.9926**2)], [1, -0.9926], normal(32).numpy()))
    x = x + normal(33)
    x[0, 5000], x[0, 11_000] = 60.0, -60.0
    comparison = compared(x, normal(34))
    white = decorrelated_record(comparison.observed)[0]
    assert abs(float(white[4800:5200].sum())) / 20 < 4  # sd of a sum of 400
    assert moving_line(comparison.observed).p_value > 1e-3
