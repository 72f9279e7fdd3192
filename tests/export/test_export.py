"""Noise models for other tools: moments and likelihoods by definition, and files read back as those tools read them."""

from __future__ import annotations

import math
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gyrofuse.export.c_header import to_c_header
from gyrofuse.export.kalibr import to_kalibr
from gyrofuse.fitting.gmwm import fit_gmwm
from gyrofuse.io.recording import Recording
from gyrofuse.noise.processes import (
    AR1,
    Drift,
    FlickerNoise,
    Matern32,
    Model,
    QuantizationNoise,
    RandomWalk,
    Sinusoid,
    WhiteNoise,
)
from gyrofuse.noise.state_space import StateSpace, state_space

# Every process with its mean at t = 1, 2, .. and its autocovariance at s, t.
ZERO = np.zeros_like
CATALOGUE = {
    "white_noise": (WhiteNoise(0.7), ZERO, lambda s, t: 0.7 * (s == t)),
    "quantization_noise": (QuantizationNoise(0.3), ZERO, lambda s, t: 0.3 * (2.0 * (s == t) - (abs(s - t) == 1))),
    "ar1": (AR1(0.97, 0.02), ZERO, lambda s, t: 0.02 / (1 - 0.97**2) * 0.97 ** abs(s - t)),
    "ar1_negative": (AR1(-0.6, 0.2), ZERO, lambda s, t: 0.2 / 0.64 * (-0.6) ** abs(s - t)),
    "matern32": (
        Matern32(0.97, 0.02),
        ZERO,
        lambda s, t: 0.02 * (1 - math.log(0.97) * abs(s - t)) * 0.97 ** abs(s - t),
    ),
    "drift": (Drift(-0.02), lambda t: -0.02 * t, lambda s, t: 0.0 * s * t),
    "random_walk": (RandomWalk(0.04), ZERO, lambda s, t: 0.04 * np.minimum(s, t)),
    "sinusoid": (Sinusoid(0.85, 0.35), ZERO, lambda s, t: 0.85**2 / 2 * np.cos(0.35 * (s - t))),
    "sinusoid_nyquist": (Sinusoid(0.4, math.pi), ZERO, lambda s, t: 0.08 * np.cos(math.pi * (s - t))),
}
SUMS = {
    "typical": ("white_noise", "ar1", "random_walk"),
    "twice_ar1": ("ar1", "white_noise", "ar1_negative"),
    "without_white": ("quantization_noise", "random_walk"),
    "everything": tuple(CATALOGUE),
}
CASES = {**{name: (name,) for name in CATALOGUE}, **SUMS}
NOISY = [name for name in CASES if name not in ("drift", "sinusoid", "sinusoid_nyquist")]


def made(case: str) -> Model:
    return sum(CATALOGUE[name][0] for name in CASES[case])


def moments(case: str, n_samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean `(time,)` and covariance `(time, time)` of the samples, from the definition of each process."""
    t = np.arange(1.0, n_samples + 1)
    mean = sum(CATALOGUE[name][1](t) for name in CASES[case])
    return mean, sum(CATALOGUE[name][2](t[:, None], t) for name in CASES[case])


def matrices(system: StateSpace) -> list[np.ndarray]:
    return [m.detach().numpy() for m in (system.F, system.Q, system.H, system.R, system.x0, system.P0)]


def system_moments(system: StateSpace, n_samples: int) -> tuple[np.ndarray, np.ndarray]:
    """The same from the matrices: states propagated sample by sample, covariances lag by lag."""
    F, Q, H, R, x, P = matrices(system)
    mean, cov = np.zeros(n_samples), np.zeros((n_samples, n_samples))
    for i in range(n_samples):
        x, P = F @ x, F @ P @ F.T + Q
        mean[i] = (H @ x)[0]
        ahead = P @ H.T
        for k in range(i, n_samples):
            cov[i, k] = cov[k, i] = (H @ ahead)[0, 0]
            ahead = F @ ahead
        cov[i, i] += R[0, 0]
    return mean, cov


def kalman_filter(system: StateSpace, signal: np.ndarray) -> float:
    """Log-likelihood sample by sample, in Joseph's form."""
    F, Q, H, R, x, P = matrices(system)
    total = 0.0
    for y in signal:
        x, P = F @ x, F @ P @ F.T + Q
        innovation, variance = y - (H @ x)[0], (H @ P @ H.T + R)[0, 0]
        gain = P @ H.T / variance
        x = x + gain[:, 0] * innovation
        rest = np.eye(len(F)) - gain @ H
        P = rest @ P @ rest.T + R * gain @ gain.T
        total -= (innovation**2 / variance + math.log(2 * math.pi * variance)) / 2
    return total


def generator(seed: int = 1) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


# --- state space ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
def test_moments_are_those_of_the_model(case):
    system = state_space(made(case), 100.0)
    for got, expected in zip(system_moments(system, 40), moments(case, 40), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("case", ["typical", "without_white", "everything"])
def test_paths_have_the_wavelet_variance_of_the_model(case):
    # 400 paths, simulated from the matrices; 6 levels, so a z of 4 is passed by chance once in 2600 runs
    model, (F, Q, H, R, x0, P0) = made(case), matrices(state_space(made(case), 1.0))
    draw = np.random.default_rng(3)
    x = x0 + draw.multivariate_normal(ZERO(x0), P0, size=400)
    y = np.empty((400, 256))
    for k in range(y.shape[1]):
        x = x @ F.T + draw.multivariate_normal(ZERO(x0), Q, size=400)
        y[:, k] = (x @ H.T)[:, 0] + math.sqrt(R[0, 0]) * draw.standard_normal(400)
    sums = np.pad(y.cumsum(-1), ((0, 0), (1, 0)))
    for level, nu in enumerate(model.wavelet_variance(6).tolist(), start=1):
        half = 2 ** (level - 1)
        w = (sums[:, 2 * half :] - 2 * sums[:, half:-half] + sums[:, : -2 * half]) / (2 * half)
        of_path = (w**2).mean(-1)
        assert abs(of_path.mean() - nu) < 4 * of_path.std(ddof=1) / 20


def test_states_have_names():
    system = state_space(made("everything"), 100.0)
    assert system.states == (
        "quantization_noise",
        "quantization_noise.carried",
        "ar1_1",
        "ar1_2",
        "matern32_1",
        "matern32_1.derivative",
        "drift",
        "drift.slope",
        "random_walk",
        "sinusoid_1.sine",
        "sinusoid_1.cosine",
        "sinusoid_2.sine",
        "sinusoid_2.cosine",
    )
    assert system.rate == 100.0
    assert (system.F.shape, system.H.shape, system.R.shape) == ((13, 13), (1, 13), (1, 1))


def test_matrices_keep_batch_dimensions():
    phi = torch.tensor([[0.9, 0.95, 0.99], [0.5, 0.0, -0.5]])
    model = AR1(phi, torch.tensor([1.0, 2.0, 3.0])) + WhiteNoise(0.1) + Sinusoid(1.0, torch.tensor([[0.2], [0.3]]))
    whole = state_space(model, 10.0)
    for i, j in np.ndindex(2, 3):
        one = state_space(model.with_params(model.params[i, j]), 10.0)
        for name in ("F", "Q", "H", "R", "x0", "P0"):
            assert getattr(whole, name).dtype == torch.float64
            assert torch.equal(getattr(whole, name)[i, j], getattr(one, name))


# --- likelihood -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", NOISY)
@pytest.mark.parametrize("n_samples", [1, 2, 60, 256, 600])
def test_likelihood_is_that_of_a_multivariate_normal(case, n_samples):
    signal = made(case).simulate(n_samples, generator=generator())
    mean, cov = moments(case, n_samples)
    residual = signal.numpy() - mean
    expected = -(
        residual @ np.linalg.solve(cov, residual) + np.linalg.slogdet(cov)[1] + n_samples * math.log(2 * math.pi)
    )
    got = state_space(made(case), 100.0).kalman_log_likelihood(signal)
    assert got.item() == pytest.approx(expected / 2, rel=1e-10)


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(WhiteNoise(1e-4) + RandomWalk(1e-13) + AR1(1 - 1e-7, 1e-14), id="nearly_white"),
        pytest.param(WhiteNoise(1e-4) + AR1(0.9997, 1e-9) + Sinusoid(0.01, 1e-3), id="slow_tone"),
        pytest.param(AR1(1 - 1e-6, 1.0), id="without_white"),
        pytest.param(RandomWalk(1.0) + QuantizationNoise(1e-4), id="walk_and_quantization"),
    ],
)
@pytest.mark.parametrize(("n_samples", "offset"), [(10_000, 0.0), (1000, 1e3)])
def test_likelihood_of_hard_models_is_that_of_the_plain_filter(model, n_samples, offset):
    # an offset far from the model is where digits would cancel
    signal = model.simulate(n_samples, generator=generator()) + offset
    system = state_space(model, 100.0)
    assert system.kalman_log_likelihood(signal).item() == pytest.approx(kalman_filter(system, signal.numpy()), rel=1e-9)


def test_likelihood_of_batches():
    phi = torch.tensor([0.9, 0.99, 0.5], dtype=torch.float64)
    model = AR1(phi, 0.1) + WhiteNoise(1.0) + Drift(0.01)
    signal = model.simulate(700, batch=(2,), generator=generator())  # (2, 3, time)
    got = state_space(model, 1.0).kalman_log_likelihood(signal)
    assert got.shape == (2, 3)
    for i, j in np.ndindex(2, 3):
        one = state_space(model.with_params(model.params[j]), 1.0)
        assert one.kalman_log_likelihood(signal[i, j]).item() == pytest.approx(got[i, j].item(), rel=1e-12)
    # one recording under many models, and many recordings under one
    first = state_space(model, 1.0).kalman_log_likelihood(signal[0, 0])
    assert first.shape == (3,)
    assert first[0].item() == pytest.approx(got[0, 0].item(), rel=1e-12)
    single = state_space(model, 1.0).kalman_log_likelihood(signal.float())
    assert single.dtype == torch.float64
    torch.testing.assert_close(single, got, rtol=1e-5, atol=0)


def test_nan_parameters_give_nan_and_leave_the_others_alone():
    variance = torch.tensor([1.0, torch.nan], dtype=torch.float64)
    signal = WhiteNoise(1.0).simulate(50, generator=generator())
    got = state_space(WhiteNoise(variance) + AR1(0.9, variance), 1.0).kalman_log_likelihood(signal)
    alone = state_space(WhiteNoise(1.0) + AR1(0.9, 1.0), 1.0).kalman_log_likelihood(signal)
    assert got[0].item() == pytest.approx(alone.item(), rel=1e-12)
    assert got[1].isnan()


def test_likelihood_is_differentiable():
    params = torch.tensor([0.7, 0.9, 0.2, 0.05, 0.4, 0.3], dtype=torch.float64, requires_grad=True)
    pattern = WhiteNoise() + AR1() + RandomWalk() + Sinusoid()
    signal = pattern.with_params(params.detach()).simulate(300, generator=generator()).requires_grad_()

    def likelihood(values, y):
        return state_space(pattern.with_params(values), 1.0).kalman_log_likelihood(y)

    assert torch.autograd.gradcheck(likelihood, (params, signal), fast_mode=True)


def test_score_has_mean_zero_at_the_truth():
    # 3 parameters, so a z of 4 is passed by chance once in 5000 runs
    params = torch.tensor([1.0, 0.95, 0.05], dtype=torch.float64).expand(200, 3).clone().requires_grad_()
    model = (WhiteNoise() + AR1()).with_params(params)
    signal = model.simulate(300, generator=generator()).detach()
    (score,) = torch.autograd.grad(state_space(model, 1.0).kalman_log_likelihood(signal).sum(), params)
    z = score.mean(0) / (score.std(0) / math.sqrt(200))
    assert (z.abs() < 4).all()


def test_likelihood_checks_its_signal():
    system = state_space(WhiteNoise(1.0), 1.0)
    with pytest.raises(TypeError, match="`signal`: expected a torch tensor"):
        system.kalman_log_likelihood([1.0])
    with pytest.raises(ValueError, match=r"`signal`: expected \(\.\.\., time\) with samples"):
        system.kalman_log_likelihood(torch.ones(2, 0))
    with pytest.raises(ValueError, match="`signal`: expected finite samples"):
        system.kalman_log_likelihood(torch.tensor([1.0, torch.nan]))


@pytest.mark.parametrize("model", [Sinusoid(1.0, 0.1), Drift(1.0), WhiteNoise(0.0) + Sinusoid(1.0, 0.1)], ids=str)
def test_without_noise_there_is_no_likelihood(model):
    with pytest.raises(ValueError, match=r"`model`: expected noise in every sample.*add WhiteNoise"):
        state_space(model, 1.0).kalman_log_likelihood(torch.ones(10))


def test_without_noise_the_batch_items_are_named():
    model = AR1(0.5, torch.tensor([1.0, 0.0, 2.0]))
    with pytest.raises(ValueError, match=r"leaves some without at batch item\(s\) \(1,\) \(1 of 3\); add"):
        state_space(model, 1.0).kalman_log_likelihood(torch.ones(10))


# --- Kalibr -----------------------------------------------------------------------------------------------


def read_lines(text: str) -> dict[str, object]:
    """Keys and values of YAML 1.1, of the plain lines written here."""
    pairs = [line.split("#")[0].split(":", 1) for line in text.splitlines() if line.split("#")[0].strip()]
    number = re.compile(r"[-+]?\d+\.\d*([eE][-+]\d+)?")
    values = {key.strip(): value.strip() for key, value in pairs}
    return {key: float(value) if number.fullmatch(value) else value for key, value in values.items()}


def read_yaml(text: str) -> dict[str, object]:
    """Keys and values, with the library where there is one."""
    try:
        import yaml
    except ImportError:
        return read_lines(text)
    assert yaml.safe_load(text) == read_lines(text)
    return yaml.safe_load(text)


def test_kalibr_keys_by_hand():
    # N = sqrt(0.05^2/100) deg/s/sqrt(Hz), K = sqrt(1e-10 100) deg/s^2/sqrt(Hz)
    text = to_kalibr(WhiteNoise(0.05**2) + RandomWalk(1e-10), 100.0, "deg/s", topic="/imu/data_raw")
    assert read_yaml(text) == {
        "rostopic": "/imu/data_raw",
        "update_rate": 100.0,
        "gyroscope_noise_density": pytest.approx(math.radians(0.005), rel=1e-9),
        "gyroscope_random_walk": pytest.approx(math.radians(1e-4), rel=1e-9),
    }
    assert "# accelerometer_noise_density:  # m/s^2/sqrt(Hz)" in text
    assert "fill in numbers > 0" in text


def test_kalibr_from_any_unit():
    def keys(scale, unit):
        return read_yaml(to_kalibr(WhiteNoise(1e-4 * scale**2) + RandomWalk(1e-9 * scale**2), 200.0, unit))

    expected = keys(1.0, "deg/s")
    del expected["rostopic"]
    for scale, unit in ((1e3, "mdeg/s"), (3600.0, "deg/h"), (math.pi / 180, "rad/s")):
        got = keys(scale, unit)
        assert got.pop("rostopic") == "/imu0"
        assert got == pytest.approx(expected, rel=1e-8)


def test_kalibr_maps_autoregressions_by_their_correlation_time():
    slow, fast, alternating = AR1(math.exp(-1 / 500), 1e-8), AR1(math.exp(-1 / 50), 1e-6), AR1(-0.5, 1e-3)
    text = to_kalibr(slow + fast + alternating, 100.0, "rad/s")  # 5 s and 0.5 s
    density = 1e-6 / (1 - math.exp(-1 / 50)) ** 2 + 1e-3 / 1.5**2
    got = read_yaml(text)
    assert got["gyroscope_random_walk"] == pytest.approx(math.sqrt(1e-8 * 100), rel=1e-9)
    assert got["gyroscope_noise_density"] == pytest.approx(math.sqrt(density / 100), rel=1e-9)
    assert "correlation time 5 s, its innovations in the random walk" in text
    assert "correlation time 0.5 s, its density at frequency 0 in the noise density" in text
    assert "no correlation time, its density" in text
    later = read_yaml(to_kalibr(slow + fast + alternating, 100.0, "rad/s", slow=0.5 - 1e-9))
    assert later["gyroscope_random_walk"] == pytest.approx(math.sqrt((1e-8 + 1e-6) * 100), rel=1e-9)


@pytest.mark.parametrize("phi", [0.0, 0.3, 0.9, 0.999, 1 - 1e-6])
def test_what_kalibr_gets_for_an_autoregression_is_no_less_noise(phi):
    true = AR1(phi, 1.0).wavelet_variance(30)
    assert (WhiteNoise(1 / (1 - phi) ** 2).wavelet_variance(30) >= true * (1 - 1e-12)).all()
    assert (RandomWalk(1.0).wavelet_variance(30) >= true * phi * (1 - 1e-12)).all()


@pytest.mark.parametrize("phi", [0.1, 0.9, 0.99, 0.9999])
def test_what_kalibr_gets_for_a_second_order_process_is_no_less_noise(phi):
    process, f = Matern32(phi, 0.3), torch.linspace(1e-6, 0.5, 20001, dtype=torch.float64)
    slow = process._white_and_walk(100.0, 1e-9, **process.values)
    fast = process._white_and_walk(100.0, 1e9, **process.values)
    assert "below a random walk" in slow.fate
    assert "density at frequency 0" in fast.fate
    assert (process.spectrum(f) <= RandomWalk(slow.walk).spectrum(f) * (1 + 1e-9)).all()
    assert (process.spectrum(f) <= WhiteNoise(fast.white).spectrum(f) * (1 + 1e-9)).all()


def test_kalibr_gets_a_random_walk_for_flicker_noise():
    process = FlickerNoise(0.3)
    walk = process._white_and_walk(64.0, 2.0, **process.values).walk
    # 128 samples are 2 s, level 8
    expected = RandomWalk(walk).wavelet_variance(8)[-1].item()
    assert process.wavelet_variance(8)[-1].item() == pytest.approx(expected, rel=1e-3)
    assert "its Allan deviation at 2 s" in to_kalibr(process + WhiteNoise(1.0), 64.0, "rad/s", slow=2.0)


def test_kalibr_says_what_it_leaves_out():
    text = to_kalibr(WhiteNoise(1.0) + QuantizationNoise(1.0) + Sinusoid(1.0, math.pi / 2) + Drift(1e-6), 10.0, "deg/s")
    for line in (
        "#   QuantizationNoise(variance=1.0): left out",
        "beta=1.5707963267948966): left out; a tone of 2.5 Hz",
        "#   Drift(slope=1e-06): left out; a ramp is not noise",
        "# gyroscope_random_walk:  # rad/s^2/sqrt(Hz); the model has none, and Kalibr demands a number > 0: fill it in",
    ):
        assert line in text
    assert "gyroscope_random_walk" not in read_yaml(text)


def test_kalibr_with_an_accelerometer():
    text = to_kalibr(
        WhiteNoise(1.0), 400.0, "rad/s", accelerometer=WhiteNoise(4e-4) + AR1(math.exp(-1 / 40000), 2.5e-11)
    )
    got = read_yaml(text)
    assert got["accelerometer_noise_density"] == pytest.approx(1e-3)
    assert got["accelerometer_random_walk"] == pytest.approx(1e-4)
    assert "fill in numbers" not in text


def fits_of_three_axes(unit, scale, walk):
    generator = torch.Generator().manual_seed(3)
    sizes = scale * torch.tensor([1.0, 3.0, 2.0], dtype=torch.float64)[:, None, None]
    noise = torch.randn(3, 1, 4000, dtype=torch.float64, generator=generator)
    noise = noise + walk * torch.randn(3, 1, 4000, dtype=torch.float64, generator=generator).cumsum(-1)
    recording = Recording(sizes * noise, rate=100.0, unit=unit, axes=("x", "y", "z"))
    return fit_gmwm(recording, "WN + RW")


def test_kalibr_of_a_whole_unit_has_the_worst_axis():
    gyros, accelerometers = fits_of_three_axes("deg/s", 1.0, 0.1), fits_of_three_axes("mg", 1.0, 0.1)
    got = read_yaml(to_kalibr(gyros, accelerometer=accelerometers))
    white, walk = gyros.params[:, 0].max(0).values.tolist()
    assert got["gyroscope_noise_density"] == pytest.approx(math.radians(math.sqrt(white / 100)), rel=1e-9)
    assert got["gyroscope_random_walk"] == pytest.approx(math.radians(math.sqrt(walk * 100)), rel=1e-9)
    white, walk = accelerometers.params[:, 0].max(0).values.tolist()
    assert got["accelerometer_noise_density"] == pytest.approx(9.80665e-3 * math.sqrt(white / 100), rel=1e-9)
    assert got["accelerometer_random_walk"] == pytest.approx(9.80665e-3 * math.sqrt(walk * 100), rel=1e-9)


def test_kalibr_gets_an_upper_limit_where_a_fit_found_nothing():
    fit = fits_of_three_axes("rad/s", 1.0, 0.0)
    fit = replace(fit, params=fit.params * torch.tensor([1.0, 0.0], dtype=torch.float64))
    text = to_kalibr(fit)
    limit = fit.confidence_interval.high[..., 1].max().item()
    assert read_yaml(text)["gyroscope_random_walk"] == pytest.approx(math.sqrt(limit * 100), rel=1e-9)
    assert limit > 0
    assert "none was found, this is the upper 95 % limit of the worst axis" in text


def test_kalibr_of_the_other_quantity_is_refused():
    accelerometers = fits_of_three_axes("m/s^2", 1.0, 0.1)
    with pytest.raises(ValueError, match=r"`unit`: expected one of deg/s.*got 'm/s\^2'"):
        to_kalibr(accelerometers)
    unknown = fit_gmwm(Recording(WhiteNoise(1.0).simulate(500, batch=(1,)), rate=100.0), "WN")
    says = '`unit`: expected that of `model`, .* such as unit="deg/s", or to `read_recording` for a log that'
    with pytest.raises(ValueError, match=says):
        to_kalibr(unknown)
    with pytest.raises(ValueError, match="`rate`: expected that of `model`, which does not say it"):
        to_kalibr(WhiteNoise(1.0))


@pytest.mark.parametrize("rate", [1e-5, 12.5, 200, 1e16])
def test_kalibr_numbers_are_numbers(rate):
    got = read_yaml(to_kalibr(WhiteNoise(1e-30) + RandomWalk(1e-30), rate, "deg/s"))
    assert got["update_rate"] == rate
    assert all(isinstance(value, float) for key, value in got.items() if key != "rostopic")


@pytest.mark.parametrize("topic", ["imu0", "", "/", "/imu 0", "/imu\nx: 1", "/imu/", 3])
def test_kalibr_topics_are_checked(topic):
    with pytest.raises(ValueError, match="`topic`: expected an absolute ROS topic name"):
        to_kalibr(WhiteNoise(1.0), 1.0, "deg/s", topic=topic)


def test_kalibr_checks_the_rest():
    with pytest.raises(ValueError, match="`slow`"):
        to_kalibr(WhiteNoise(1.0), 1.0, "deg/s", slow=0.0)
    with pytest.raises(ValueError, match=r"`accelerometer`: expected scalar parameters, got a batch of shape \(3,\)"):
        to_kalibr(WhiteNoise(1.0), 1.0, "deg/s", accelerometer=WhiteNoise(torch.ones(3)))


# --- C header ---------------------------------------------------------------------------------------------

PROGRAM = """
#include <stdio.h>
#include "noise.h"
#include "noise.h"
#define SHOW(array) show(#array, (const double *)array, sizeof array / sizeof(double))
static void show(const char *name, const double *values, size_t count) {
    printf("%s", name);
    for (size_t i = 0; i < count; i++) printf(" %.17g", values[i]);
    printf("\\n");
}
int main(void) {
    printf("n %d\\nrate %.17g\\n", GYRO_N_STATES, GYRO_RATE_HZ);
    SHOWN
    return 0;
}
"""


def compiled(header: str, arrays: list[str], folder: Path) -> dict[str, list[float]]:
    """What a C program finds in a header."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("needs a C compiler, gcc or cc")
    (folder / "noise.h").write_text(header)
    (folder / "main.c").write_text(PROGRAM.replace("SHOWN", " ".join(f"SHOW(gyro_{key});" for key in arrays)))
    strict = ["-std=c99", "-pedantic-errors", "-Wall", "-Wextra", "-Werror"]
    subprocess.run([compiler, *strict, "main.c", "-o", "main"], cwd=folder, check=True)
    out = subprocess.run([folder / "main"], capture_output=True, text=True, check=True).stdout
    return {line.split()[0]: [float(value) for value in line.split()[1:]] for line in out.splitlines()}


@pytest.mark.parametrize("case", ["typical", "everything"])
def test_header_compiles_and_reads_back(case, tmp_path):
    system = state_space(made(case), 12.5)
    keys = ["F", "Q", "H", "R", "x0", "P0"]
    got = compiled(to_c_header(made(case), 12.5, "deg/h", name="gyro"), keys, tmp_path)
    assert (got["n"], got["rate"]) == ([len(system.states)], [12.5])
    for key in keys:
        assert got[f"gyro_{key}"] == getattr(system, key).flatten().tolist()


def test_header_of_white_noise_has_no_states(tmp_path):
    header = to_c_header(WhiteNoise(0.1), 100.0, "deg/s", name="gyro")
    assert compiled(header, ["R"], tmp_path) == {"n": [0], "rate": [100.0], "gyro_R": [0.1]}
    assert "gyro_F" not in header


def test_header_says_units_and_states():
    header = to_c_header(made("everything"), 50.0, "mdeg/s")
    for line in (
        "Noise of a rate sensor in mdeg/s, one step per sample at 50 Hz",
        "state 2: ar1_1, mdeg/s",
        "state 5: matern32_1.derivative, mdeg/s",
        "state 7: drift.slope, mdeg/s per sample",
        "#ifndef IMU_NOISE_H_INCLUDED",
        "static const double imu_noise_Q[13][13]",
        "/* variance of v, (mdeg/s)^2 */",
    ):
        assert line in header


@pytest.mark.parametrize("name", ["", "2gyro", "gyro-x", "double", "_Gyro", "gyro\n", None])
def test_header_names_are_checked(name):
    with pytest.raises(ValueError, match="`name`: expected a C identifier"):
        to_c_header(WhiteNoise(1.0), 1.0, "deg/s", name=name)


# --- arguments of all -------------------------------------------------------------------------------------

EXPORTS = {
    "kalibr": lambda model, rate=1.0, unit="deg/s": to_kalibr(model, rate, unit),
    "state_space": lambda model, rate=1.0, unit="deg/s": state_space(model, rate),
    "c_header": lambda model, rate=1.0, unit="deg/s": to_c_header(model, rate, unit),
}


@pytest.mark.parametrize("export", EXPORTS.values(), ids=EXPORTS)
def test_arguments_are_checked(export):
    with pytest.raises(ValueError, match="`rate`: expected a finite number > 0"):
        export(WhiteNoise(1.0), rate=0.0)
    with pytest.raises(ValueError, match=r"`ar1_2.phi`.*to be estimated"):
        export(WhiteNoise(1.0) + AR1(0.5, 1.0) + AR1(variance=1.0))


@pytest.mark.parametrize("export", [EXPORTS["kalibr"], EXPORTS["c_header"]])
def test_files_are_of_one_sensor_in_a_known_unit(export):
    with pytest.raises(ValueError, match=r"`unit`: expected one of deg/s, .*got 'counts'"):
        export(WhiteNoise(1.0), unit="counts")
    with pytest.raises(ValueError, match=r"`model`: expected scalar parameters, got a batch of shape \(2,\)"):
        export(WhiteNoise(torch.ones(2)))


@pytest.mark.parametrize("write", [to_kalibr, to_c_header])
def test_a_formula_is_no_model(write):
    with pytest.raises(TypeError, match="expected a model, got str 'WN'; a formula has no values: fit it"):
        write("WN", 100.0, "deg/s")
