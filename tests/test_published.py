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
    haar_coefficients,
    resolve_scale_weights,
    svo_weights,
    wavelet_cross_covariance,
    wavelet_variance,
)


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


@pytest.mark.parametrize(
    ("clock", "series", "n_octaves"),
    [
        ("cs5071a", "cs5071a_phase_s", 6),
        ("gps", "gps1pps_phase_s", 16),
        ("ocxo", "ocxo_frequency_hz", 7),
        ("tic", "tic_phase_s", 14),
    ],
)
def test_stable32_on_four_clocks(shared, clock, series, n_octaves):
    """Stable32 prints five digits: 5e-5 of rounding, and a little for its own arithmetic."""
    with np.load(shared / "data" / "clocks_stable32.npz") as data:
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
