"""The Haar filter bank against its definition, by hand and as layers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference import haar as naive

from gyrofuse import HaarFilterBank, haar_coefficients


def array(n_sensors: int, n_samples: int) -> torch.Tensor:
    return torch.from_numpy(naive.array(n_sensors, n_samples))


def assert_coefficients(got: list[torch.Tensor], signal: torch.Tensor, rtol: float = 1e-12) -> None:
    """Every level equals its definition, to `rtol` of the level's root mean square, with the same ones missing."""
    for level, w in enumerate(got, start=1):
        expected = naive.coefficients(signal.double().numpy(), level).astype(float)
        size = np.sqrt(np.nanmean(expected**2)) if np.isfinite(expected).any() else 1.0
        np.testing.assert_allclose(w.double().numpy(), expected, rtol=0, atol=rtol * size, equal_nan=True)


def test_by_hand():
    first, second = haar_coefficients(torch.tensor([[0.0, 2.0, 4.0, 8.0]], dtype=torch.float64))
    assert first.tolist() == [[1.0, 1.0, 2.0]]
    assert second.tolist() == [[2.5]]  # ((4 + 8)/2 - (0 + 2)/2) / 2


def test_an_impulse_shows_the_filters_newest_half_first():
    impulse = torch.zeros(1, 15, dtype=torch.float64)
    impulse[0, 7] = 1.0
    third = haar_coefficients(impulse, 3)[2]
    # Entry t belongs to the window that ends at sample t + 7: the impulse enters by the newest half.
    assert third.tolist() == [[1 / 8] * 4 + [-1 / 8] * 4]


@pytest.mark.parametrize("n_samples", [2, 3, 4, 5, 16, 17, 100, 1000, 1024])
def test_equals_the_definition(n_samples):
    signal = array(3, n_samples)
    coefficients = haar_coefficients(signal)
    assert [w.shape[-1] for w in coefficients] == [n_samples - 2**j + 1 for j in range(1, 11) if 2**j <= n_samples]
    assert_coefficients(coefficients, signal)


@pytest.mark.parametrize("offset", [0.0, 250.0, 1e6])
def test_an_offset_costs_no_digits(offset):
    signal = array(2, 500)
    for plain, moved in zip(haar_coefficients(signal), haar_coefficients(signal + offset), strict=True):
        torch.testing.assert_close(moved, plain, rtol=0, atol=4e-16 * max(offset, 1))


def test_float32_keeps_its_digits_under_a_large_offset():
    signal = (array(2, 4096) + 250).float()
    assert_coefficients(haar_coefficients(signal), signal, rtol=1e-5)


def test_a_constant_is_ignored_and_a_drift_gives_a_quarter_of_its_length():
    time = torch.arange(64, dtype=torch.float64)
    for level, w in enumerate(haar_coefficients(torch.stack([torch.full_like(time, 3.7), 0.01 * time])), start=1):
        assert w[0].abs().max() < 1e-15
        torch.testing.assert_close(w[1], torch.full_like(w[1], 0.01 * 2**level / 4), rtol=1e-12, atol=0)


def test_windows_with_a_missing_sample_are_missing():
    signal = array(3, 200)
    signal[0, 50] = torch.nan
    signal[1, 100:120] = torch.inf
    signal[2, -1] = -torch.inf
    coefficients = haar_coefficients(signal)
    assert_coefficients(coefficients, signal)
    assert coefficients[0].isnan().sum(-1).tolist() == [2, 21, 1]
    assert coefficients[-1].isnan()[1].all()


def test_missing_sensor_leaves_the_others_alone():
    signal = array(3, 64)
    signal[1] = torch.nan
    for w in haar_coefficients(signal):
        assert w.isnan().any(-1).tolist() == [False, True, False]


@pytest.mark.parametrize("shape", [(2, 4, 100), (3, 1, 2, 33), (0, 3, 40)])
def test_leading_dimensions_are_kept(shape):
    signal = torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    coefficients = haar_coefficients(signal, 4)
    assert [tuple(w.shape) for w in coefficients] == [(*shape[:-1], shape[-1] - 2**j + 1) for j in range(1, 5)]
    assert_coefficients([w for w in coefficients if w.numel()], signal)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_layers_equal_the_function(dtype):
    signal = array(5, 300).to(dtype)
    bank = HaarFilterBank(6)
    for layer, function in zip(bank(signal), haar_coefficients(signal, 6), strict=True):
        assert layer.dtype == dtype
        assert torch.equal(layer, function)


def test_the_layers_are_fixed():
    bank = HaarFilterBank(6)
    assert list(bank.parameters()) == []
    assert bank.state_dict() == {}
    assert repr(bank) == "HaarFilterBank(n_levels=6)"
    # A module cast to float32 still computes in the dtype of the signal, exactly.
    signal = array(2, 100)
    assert torch.equal(bank.to(torch.float32)(signal)[5], haar_coefficients(signal, 6)[5])


@pytest.mark.parametrize("make", [haar_coefficients, lambda signal, n_levels: HaarFilterBank(n_levels)(signal)])
@pytest.mark.parametrize(
    ("signal", "n_levels", "error", "message"),
    [
        (torch.zeros(2, 8).numpy(), 2, TypeError, "`signal`: expected a torch tensor, got ndarray"),
        (torch.zeros(2, 8, dtype=torch.int16), 2, TypeError, r"`signal`: expected float32 or float64, got torch.int16"),
        (torch.zeros(2, 8).half(), 2, TypeError, r"`signal`: expected float32 or float64, got torch.float16"),
        (torch.zeros(8), 2, ValueError, r"`signal`: expected \(..., sensor, time\), got shape \(8,\).*unsqueeze"),
        (torch.zeros(0, 8), 2, ValueError, r"`signal`: expected at least one sensor, got shape \(0, 8\)"),
        (torch.zeros(2, 1), 1, ValueError, "`signal`: expected at least 2 samples for one wavelet level, got 1"),
        (torch.zeros(2, 15), 4, ValueError, "`n_levels`: expected at most 3 for 15 samples .*, got 4"),
        (torch.zeros(2, 8), 0, ValueError, "`n_levels`: expected a whole number >= 1, got 0"),
        (torch.zeros(2, 8), 1.5, ValueError, "`n_levels`: expected a whole number >= 1, got 1.5"),
        (torch.zeros(2, 8), True, ValueError, "`n_levels`: expected a whole number >= 1, got True"),
        (torch.zeros(2, 8), "2", ValueError, "`n_levels`: expected a whole number >= 1, got '2'"),
    ],
)
def test_bad_input_is_named(make, signal, n_levels, error, message):
    with pytest.raises(error, match=message):
        make(signal, n_levels)
