"""What the simulation has with other numbers, or alone: filters, resonances, rounding after both, courses of a bias."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import signal

import gyrofuse as gf
from gyrofuse.mismatch import Finding, MismatchReport
from gyrofuse.mismatch.detectors.values.truncation import is_cut_off, step_counts
from gyrofuse.mismatch.mechanisms.values.rounding.quantization import Quantization
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo

RATE, N = 200.0, 24_000


def noise(seed: int, p: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    walk = signal.lfilter([0.002], [1, -0.9999], rng.standard_normal((p, N)))
    return 0.1 * rng.standard_normal((p, N)) + walk


def low_passed(x: np.ndarray, order: int, corner: float) -> np.ndarray:
    return signal.lfilter(*signal.butter(order, corner, fs=RATE), x, axis=-1)


def rounded(x: np.ndarray, step: float) -> np.ndarray:
    return step * np.round(x / step)


def ringing(seed: int, centre: float, quality: float, size: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    ring = signal.lfilter(*signal.iirpeak(centre, quality, RATE), rng.standard_normal((3, N)))
    return noise(seed + 1) + size * ring


def diagnosed(recording: np.ndarray, simulation: np.ndarray) -> MismatchReport:
    sides = (gf.Recording(torch.from_numpy(np.ascontiguousarray(x)), rate=RATE) for x in (recording, simulation))
    return gf.diagnose(*sides, generator=torch.Generator().manual_seed(0))


def holds(finding: Finding, name: str, truth: float, slack: float = 0.0) -> bool:
    entry = finding.parameters[name]
    return entry.low * (1 - slack) <= truth <= entry.high * (1 + slack)


@pytest.mark.slow
@pytest.mark.parametrize(("order", "corner", "step"), [(1, 30.0, 0.05), (2, 22.0, 0.06)])
def test_a_filter_in_front_of_the_converter_has_its_own_corner(order: int, corner: float, step: float) -> None:
    report = diagnosed(rounded(low_passed(noise(1), order, corner), step), rounded(noise(2), step))
    (finding,) = report.findings
    assert (finding.mechanism, finding.sensors) == ("low_pass", (0, 1, 2))
    assert all(holds(finding, f"corner[{i}]", corner, 0.005) for i in range(3))
    assert report.held_out.after < 2.3
    assert not report.unexplained


@pytest.mark.slow
def test_a_filter_is_told_though_its_noise_is_smaller_than_a_step() -> None:
    report = diagnosed(rounded(low_passed(noise(3), 1, 20.0), 0.1), noise(4))
    assert sorted(f.mechanism for f in report.findings) == ["low_pass", "quantization"]
    (filtered,) = (f for f in report.findings if f.mechanism == "low_pass")
    assert all(holds(filtered, f"corner[{i}]", 20.0, 0.02) for i in range(3))
    assert report.held_out.after < 1.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("orders", "corners", "step"),
    [((2, 2), (40.0, 30.0), 0.0), ((3, 1), (25.0, 40.0), 0.0), ((1, 1), (50.0, 32.0), 0.05)],
)
def test_a_filter_of_another_corner_than_the_simulations(
    orders: tuple[int, int], corners: tuple[float, float], step: float
) -> None:
    sides = [low_passed(noise(5 + k), orders[k], corners[k]) for k in (0, 1)]
    report = diagnosed(*(rounded(x, step) if step else x for x in sides))
    (finding,) = report.findings
    assert (finding.mechanism, finding.sensors) == ("low_pass", (0, 1, 2))
    off = 0.1 if step else 0.02  # where rounding hides what is left near half the rate, one goes with the other
    assert all(holds(finding, f"corner[{i}]", corners[0], off) for i in range(3))
    assert holds(finding, "simulated_corner", corners[1], off)
    assert report.held_out.after < 1.5


@pytest.mark.slow
def test_a_filter_of_another_corner_beside_a_sensor_without_one() -> None:
    """The sensor without says nothing of the simulation's filter."""
    sides = [noise(105 + k) for k in (0, 1)]
    for side, corner in zip(sides, (40.0, 25.0), strict=True):
        side[1:] = low_passed(side[1:], 2, corner)
    (finding,) = diagnosed(*sides).findings
    assert (finding.mechanism, finding.sensors) == ("low_pass", (1, 2))
    assert all(holds(finding, f"corner[{i}]", 40.0, 0.03) for i in (1, 2))
    assert holds(finding, "simulated_corner", 25.0, 0.03)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recorded", "simulated"),
    [
        ((42.0, 20.0, 0.5), (42.0, 20.0, 0.8)),
        ((42.0, 20.0, 0.5), (44.0, 20.0, 0.5)),
        ((42.0, 50.0, 0.5), (42.0, 20.0, 0.5)),
    ],
)
def test_a_resonance_of_other_numbers_than_the_simulations(
    recorded: tuple[float, float, float], simulated: tuple[float, float, float]
) -> None:
    report = diagnosed(ringing(10, *recorded), ringing(20, *simulated))
    (finding,) = report.findings
    assert (finding.mechanism, finding.sensors) == ("resonance", (0, 1, 2))
    for prefix, (centre, quality, _) in (("", recorded), ("simulated_", simulated)):
        assert finding.parameters[f"{prefix}frequency"].value == pytest.approx(centre, rel=0.005)
        assert finding.parameters[f"{prefix}width"].value == pytest.approx(centre / quality, rel=0.15)
    ratio = finding.parameters["rms[0]"].value / finding.parameters["simulated_rms[0]"].value
    expected = recorded[2] / simulated[2] * (recorded[0] / recorded[1] / (simulated[0] / simulated[1])) ** 0.5
    assert ratio == pytest.approx(expected, rel=0.1)
    assert report.held_out.after < 2.3


def test_a_resonance_of_the_same_numbers_is_no_finding() -> None:
    assert not diagnosed(ringing(10, 42.0, 20.0, 0.5), ringing(20, 42.0, 20.0, 0.5)).mismatch


@pytest.mark.parametrize(("order", "corner", "step"), [(0, 0.0, 0.15), (1, 40.0, 0.08), (2, 60.0, 0.05)])
def test_what_was_rounded_has_its_spectrum_again(order: int, corner: float, step: float) -> None:
    """Below a stop band, too, where all that is seen is the rounding."""
    white = 0.1 * np.random.default_rng(1).standard_normal((2, N))
    true = low_passed(white, order, corner) if order else white
    came = torch.from_numpy(rounded(true, step))
    comparison = Comparison.of(RecordingInfo(RATE, "unknown", ("a", "b")), came, came[None])
    own = Quantization.in_reference(comparison)
    assert own is not None
    analog = own.undo_in_reference(comparison, torch.Generator().manual_seed(1)).analog[0].numpy()
    f, before = signal.welch(true, RATE, nperseg=512)
    after = signal.welch(analog, RATE, nperseg=512)[1]
    plain = before.mean(0) > step**2 / 12 * 2 / RATE  # above what rounding adds
    assert np.abs(np.log(after[:, plain].mean(0) / before[:, plain].mean(0))).mean() < 0.1
    added = np.maximum(after - before, 0)[:, ~plain & (f < 0.98 * RATE / 2)]
    assert added.size == 0 or added.mean() < 0.2 * step**2 / 12 * 2 / RATE


def test_the_density_of_noise_with_a_stop_band_is_its_own() -> None:
    x = torch.from_numpy(low_passed(noise(7), 2, 50.0))
    side = Comparison.of(RecordingInfo(RATE, "unknown", ("a", "b", "c")), x, x[None]).reference
    f = torch.linspace(0.05, 0.45, 400, dtype=torch.float64)
    true = 0.01 * np.abs(signal.freqz(*signal.butter(2, 50.0, fs=RATE), worN=2 * np.pi * f.numpy())[1]) ** 2
    assert np.abs(np.log(side.density(f).numpy() / true)).mean() < 0.1


@pytest.mark.parametrize(("name", "size"), [("step", 0.8), ("warm_up_transient", 1.5)])
def test_a_course_of_the_simulation_alone_is_told_and_leaves_its_noise_model(name: str, size: float) -> None:
    t = np.arange(N) / RATE
    course = np.where(t > 50, size, 0.0) if name == "step" else size * np.exp(-t / 12)
    simulation = noise(22)
    simulation[:2] += course
    report = diagnosed(noise(21), simulation)
    (finding,) = report.findings
    assert (finding.mechanism, finding.sensors) == (name, (0, 1))
    assert finding.sentence.startswith("only in the simulation the bias of sensors 1, 2")
    assert all(holds(finding, f"size[{i}]", size, 0.05) for i in (0, 1))
    assert not report.unexplained
    drawn = report.model.simulate(N, generator=torch.Generator().manual_seed(1))
    ends = drawn[:, -2000:].mean(-1) - drawn[:, :2000].mean(-1)
    assert float(ends.abs().max()) < 0.7 * size


def cut_off(seed: int, step: float) -> np.ndarray:
    """Of a bias that hardly leaves zero, around which fractions are lost in another way than elsewhere."""
    return step * np.trunc(steady_noise(seed) / step)


def steady_noise(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    walk = signal.lfilter([0.001], [1, -0.999], rng.standard_normal((3, N)))
    return 0.1 * rng.standard_normal((3, N)) + walk


@pytest.mark.slow
@pytest.mark.parametrize("rounds", [False, True])
def test_a_converter_that_drops_the_fraction_is_told_from_one_that_rounds(rounds: bool) -> None:
    simulation = steady_noise(32)
    report = diagnosed(cut_off(31, 0.12), rounded(simulation, 0.12) if rounds else simulation)
    (finding,) = report.findings
    assert isinstance(finding.effect, Quantization)
    assert finding.effect.cut_off == (True, True, True)
    assert "cut off towards zero in all of them" in finding.sentence
    assert not report.unexplained
    assert report.held_out.after < 1.5


def test_simulations_that_drop_the_fraction_as_the_recording_does_agree() -> None:
    assert not diagnosed(cut_off(33, 0.12), cut_off(34, 0.12)).mismatch


@pytest.mark.parametrize(("seed", "share", "wanted"), [(1, 0.0, True), (2, 0.1, None), (3, 0.5, None)])
def test_zeros_in_the_place_of_lost_values_are_no_fractions_cut_off(
    seed: int, share: float, wanted: bool | None
) -> None:
    rng = np.random.default_rng(seed)
    values = 1.5 * rng.standard_normal(20_000) + 0.4
    values = np.trunc(values) if share == 0 else np.where(rng.random(20_000) < share, 0.0, np.round(values))
    unique, counts = torch.unique(torch.from_numpy(values), return_counts=True)
    assert is_cut_off(step_counts(unique, counts, 1.0)) is wanted
    values = np.round(1.5 * rng.standard_normal(20_000) + 0.4)
    unique, counts = torch.unique(torch.from_numpy(values), return_counts=True)
    assert is_cut_off(step_counts(unique, counts, 1.0)) is False
