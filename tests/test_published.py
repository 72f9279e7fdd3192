"""Numbers that others published or that other software gave, reproduced to the digits they carry.

Each tolerance follows from the digits printed: n significant digits round by at most half a unit of the last, which
is 5 * 10**-n relative to a number that begins with 1.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference import published

from gyrofuse import (
    RandomWalk,
    WhiteNoise,
    haar_coefficients,
    svo_weights,
    wavelet_cross_covariance,
    wavelet_variance,
)
from gyrofuse.fusion.weights.svo import resolve_scale_weights
from gyrofuse.wavelets import block_length
from gyrofuse.wavelets.intervals import equivalent_dof
from gyrofuse.wavelets.long_run_variance import mean_covariance
from gyrofuse.wavelets.pilot import fit_pilot


def allan_deviation(frequency: np.ndarray) -> np.ndarray:
    """Overlapped Allan deviation at averaging times 1, 2, 4, ... samples: the root of twice the Haar variance."""
    return (2 * wavelet_variance(torch.as_tensor(frequency, dtype=torch.float64)[None])[:, 0]).sqrt().numpy()


@pytest.fixture(scope="module")
def array() -> torch.Tensor:
    """Four sensors, 4096 samples, that R's packages were given."""
    return torch.from_numpy(published.array())


@pytest.fixture(scope="module")
def single() -> torch.Tensor:
    """One series of 4096 samples."""
    return torch.from_numpy(published.series())[None]


def test_adis16405_as_published_with_the_r_package_wv(shared):
    """Three hours of a static ADIS16405, three gyros and three accelerometers, 18 levels."""
    with np.load(shared / "data" / "adis16405_rec1.npz") as data:
        signal = torch.from_numpy(data["counts"] * data["scale"][:, None])
    channels = published.table("r_wv")["adis16405"]
    assert list(channels) == ["Gyro. X", "Gyro. Y", "Gyro. Z", "Accel. X", "Accel. Y", "Accel. Z"]
    expected = np.stack(list(channels.values()), axis=-1)
    assert expected.shape == (18, 6)
    np.testing.assert_allclose(wavelet_variance(signal, 18), expected, rtol=1e-9)


CLOCKS = [
    ("cs5071a", "cs5071a_phase_s", 6),
    ("gps", "gps1pps_phase_s", 16),
    ("ocxo", "ocxo_frequency_hz", 7),
    ("tic", "tic_phase_s", 14),
]


def test_stable32_on_four_clocks(shared, subtests):
    """Stable32 prints five digits: 5e-5 of rounding, and a little for its own arithmetic."""
    data = np.load(shared / "data" / "clocks_stable32.npz")
    for clock, series, n_octaves in CLOCKS:
        with subtests.test(clock=clock):
            frequency = data[series] / 1e7 - 1 if series.endswith("hz") else np.diff(data[series]) / data["tau0"]
            factor, _, number, _, deviation = data[f"{clock}_oadev"].T
            level = np.log2(factor)
            octave = level == np.round(level)
            assert octave.sum() == n_octaves
            got = allan_deviation(frequency)[level[octave].astype(int)]
            np.testing.assert_allclose(got, deviation[octave], rtol=6e-5)
            assert (number[octave] == len(frequency) - 2 * factor[octave] + 1).all()


def test_nbs14_with_10_points():
    """NIST Special Publication 1065, table 31: seven digits; the phase itself is given to five decimals of 100."""
    tables = published.table("allan")
    expected = tables["nbs14_10pt"]["OADEV"]
    np.testing.assert_allclose(allan_deviation(tables["nbs14_freq"])[:2], expected, rtol=1e-7)
    np.testing.assert_allclose(allan_deviation(np.diff(tables["nbs14_phase"]))[:2], expected, rtol=1e-7)


def test_nbs14_with_1000_points():
    """The congruential generator of NIST SP 1065, table 32. Of its averaging times (1, 10, 100) one is a power of 2."""
    state, frequency = 1234567890, []
    for _ in range(1000):
        frequency.append(state / 2147483647)
        state = 16807 * state % 2147483647
    expected = published.table("allan")["nbs14_1000pt"]["OADEV"][0]
    np.testing.assert_allclose(allan_deviation(np.array(frequency))[0], expected, rtol=2e-7)


def test_stable32_on_its_own_sample_file():
    """PHASE.DAT, all octaves of the table, five digits."""
    tables = published.table("allan")
    got = allan_deviation(np.diff(tables["phasedat_phase"]))
    table = tables["stable32_phasedat_oadev_octave"]
    column = dict(zip(table["cols"], np.array(table["rows"]).T, strict=True))
    assert column["m"].tolist() == [2**j for j in range(8)]
    np.testing.assert_allclose(got[:8], column["sigma"], rtol=5e-5)


def test_r_wv_on_one_series(single):
    """Fifteen digits of the wavelet variances, and the first coefficients of each level.

    R's `modwt` orders and signs its coefficients as ours: newest half minus previous half, without those whose window
    would begin before the series, and without the factor `sqrt(2)**j` of the orthonormal transform.
    """
    reference = published.table("r_wv")["modwt"]
    np.testing.assert_allclose(wavelet_variance(single, 11)[:, 0], reference["variance"], rtol=1e-13)
    coefficients = haar_coefficients(single, 11)
    assert [w.shape[-1] for w in coefficients] == np.ravel(reference["lengths"]).tolist()
    for w, first in zip(coefficients, reference["first5"], strict=True):
        np.testing.assert_allclose(w[0, :5], first, rtol=0, atol=1e-14)


def test_r_wv_and_synimu_cross_covariances(array):
    """Fifteen digits of every pair, the off-diagonal ones in units of the two sensors' deviations."""
    reference = published.table("r_wv")
    got = wavelet_cross_covariance(array, 11).numpy()
    deviation = np.sqrt(np.einsum("jii->ji", got))
    np.testing.assert_allclose(wavelet_variance(array, 11), reference["wvar"], rtol=1e-13)
    np.testing.assert_allclose(deviation**2, reference["wvar"], rtol=1e-13)
    for name, table in reference["wccv"].items():
        i, k = (int(number) - 1 for number in name.removeprefix("pair_").split("_"))
        error = (got[:, i, k] - np.array(table)) / (deviation[:, i] * deviation[:, k])
        assert np.abs(error).max() < 1e-13
    i, k = np.triu_indices(4, 1)
    error = (got[:, i, k] - np.array(published.table("synimu")["wccv"])) / (deviation[:, i] * deviation[:, k])
    assert np.abs(error).max() < 1e-13


@pytest.mark.parametrize("scales", ["equal", "inv_scale", "last3", "first"])
def test_synimu_weights(array, scales):
    """Fifteen digits of the matrix A, and of the weights as far as its condition number (1e2 for `last3`) lets them."""
    reference = published.table("synimu")
    omega = np.array(reference["scale_weights"][scales])
    wccv = wavelet_cross_covariance(array, 11)
    combined = np.einsum("j,jik->ik", resolve_scale_weights(omega, 11).numpy(), wccv.numpy())
    np.testing.assert_allclose(combined, reference["A"][scales], rtol=0, atol=1e-14)
    np.testing.assert_allclose(svo_weights(wccv, omega), reference["coefs"][scales], rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", ["short", "long"])
@pytest.mark.parametrize(("study", "n_levels"), [("simulation", 19), ("case_study", 21)])
def test_scale_weights_of_the_paper(study, n_levels, name):
    """Three decimals of Zhang et al.: half of the last one. Long scales at 21 levels turn at level 15."""
    settings = published.table("zhang")
    printed = (settings if study == "simulation" else settings[study])[f"scale_weights_{name}"]
    assert len(printed) == n_levels
    np.testing.assert_allclose(resolve_scale_weights(name, n_levels), printed, rtol=0, atol=5e-4)


@pytest.fixture
def python_packages() -> dict:
    """What PyWavelets, arch, statsmodels and allantools gave (`tests/reference/published/make_python_packages.py`)."""
    return published.table("python_packages")


def test_pywavelets_coefficients(single, python_packages):
    """Every `2**j`-th of our coefficients is one of its orthonormal transform, but for the factor `-sqrt(2)**j`."""
    for level, expected in enumerate(python_packages["haar"]["coefficients"], 1):
        got = haar_coefficients(single, level)[-1][0, :: 2**level][: len(expected)] * 2 ** (level / 2)
        np.testing.assert_allclose(got, -np.array(expected), rtol=0, atol=1e-13)


def test_arch_block_length(python_packages):
    """The same rule with the definition of its bandwidth read otherwise, one lag longer: up to 16 % in a length.

    On the mean over 24 series that is 0.3 %, where a slip of a constant (2 for 4/3, 1 for 3/2) is 14 %.
    """
    expected = np.array(python_packages["block_length"]["lengths"])
    got = block_length._politis_white(torch.from_numpy(published.memories(len(expected), 256))).numpy()
    ratio = np.log(got / expected)
    assert np.abs(ratio).max() < 0.18
    assert abs(ratio.mean()) < 0.03


def test_statsmodels_long_run_variance(python_packages):
    """Another estimator of the same quantity: cosines here, Bartlett's weights there, 24 series of 16384 samples.

    Each ratio scatters by 8 %, their mean by 2 %: a factor of 2, of the bin or of the number of cosines stands out.
    """
    expected = np.array(python_packages["long_run_variance"]["variances"])
    n_samples, length = 2**14, 64
    sums = torch.from_numpy(published.memories(len(expected), n_samples)).unflatten(-1, (-1, length)).sum(-1)
    counts = torch.full(sums.shape, float(length), dtype=torch.float64)
    got = mean_covariance(sums[..., None], counts, torch.full(sums.shape[:1], 48.0))[:, 0, 0].numpy() * n_samples
    ratio = np.log(got / expected)
    assert abs(ratio.mean()) < 0.06
    assert ratio.std() < 0.15
    assert np.corrcoef(got, expected)[0, 1] > 0.85


@pytest.mark.parametrize(("name", "process"), [("white_noise", WhiteNoise(1.0)), ("random_walk", RandomWalk(1.0))])
def test_allantools_degrees_of_freedom(name, process, python_packages):
    """Greenhall's degrees of freedom of an overlapped Allan variance of the same noise, from the seventh octave on.

    The pilot model serves the last levels alone; below them intervals come from the series itself.
    """
    expected = np.array(python_packages["degrees_of_freedom"][name])
    pilot = fit_pilot(process.wavelet_variance(11).reshape(1, 11, 1, 1), 4096)
    got = pilot.dof(torch.ones(1, 1, 1, dtype=torch.float64))[0, :, 0].numpy()
    np.testing.assert_allclose(got[6:], expected[6:], rtol=0.015)


def test_allantools_least_degrees_of_freedom(python_packages):
    """Without a model, those of the less favourable of white noise and random walk, at least where they are many."""
    degrees = python_packages["degrees_of_freedom"]
    expected = np.minimum(degrees["white_noise"], degrees["random_walk"])
    counts = 4097 - torch.exp2(torch.arange(1.0, 12, dtype=torch.float64))
    got = equivalent_dof(counts).numpy()
    np.testing.assert_allclose(got[1:9], expected[1:9], rtol=0.06)
    assert (got < 1.06 * expected).all()
