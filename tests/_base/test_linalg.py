"""What is said about a covariance that has no inverse."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference import haar as naive

from gyrofuse import SingularCovarianceError
from gyrofuse._base.linalg import check_positive_definite


def covariance(*rows: np.ndarray) -> torch.Tensor:
    """Sample covariance of sensors `(sensor, time)`."""
    values = torch.from_numpy(np.stack(rows))
    return values @ values.T / values.shape[-1]


A, B, C, D = np.random.default_rng(2).normal(size=(4, 1000))
LABELS = ["left", "right", "front", "rear"]


def check(matrix: torch.Tensor, labels: list[str] | None = None) -> None:
    check_positive_definite("the covariance", matrix, labels)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ((A, B, 0 * C, D), r"the covariance is not positive definite: sensor\(s\) front never change.*leave them out"),
        ((0 * A, B, 0 * C, D), r"sensor\(s\) left, front never change \(dead or stuck\)"),
        ((A, B, C, B), "sensors right and rear are copies of each other; keep one of each"),
        ((A, B, -3 * A, D), "sensors left and front are copies of each other"),
        ((A, A, A, D), "sensors left and right, left and front, right and front are copies"),
        ((A, B, A + B, D), "linearly dependent, or the recording is too short.*record longer"),
        ((A[:3], B[:3], C[:3], D[:3]), "linearly dependent, or the recording is too short"),
    ],
)
@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
def test_the_cause_and_the_sensors_are_named(rows, message, size):
    with pytest.raises(SingularCovarianceError, match=message):
        check(size * covariance(*rows), LABELS)


def test_missing_sensors_are_named():
    matrix = covariance(A, B, C, D)
    matrix[1] = matrix[:, 1] = torch.nan
    with pytest.raises(SingularCovarianceError, match=r"sensor\(s\) right have no complete window at some level"):
        check(matrix, LABELS)
    matrix = covariance(A, B, C, D)
    matrix[0, 2] = matrix[2, 0] = torch.nan
    with pytest.raises(SingularCovarianceError, match="some sensors are never recorded together"):
        check(matrix, LABELS)


def test_an_indefinite_matrix_is_refused():
    matrix = torch.tensor([[1.0, 0.9, 0.0], [0.9, 1.0, 0.9], [0.0, 0.9, 1.0]], dtype=torch.float64)
    with pytest.raises(SingularCovarianceError, match="linearly dependent"):
        check(matrix)
    matrix[0, 0] = -1.0
    with pytest.raises(SingularCovarianceError, match=r"sensor\(s\) 1 never change"):
        check(matrix)


def test_items_of_a_batch_are_counted_and_named():
    good, bad = covariance(A, B), covariance(A, A)
    batch = torch.stack([good, bad, good, bad]).view(2, 2, 2, 2)
    with pytest.raises(SingularCovarianceError, match=r"item\(s\) \(0, 1\), \(1, 1\) \(2 of 4\): sensors 1 and 2"):
        check(batch)
    with pytest.raises(SingularCovarianceError, match=r"\(4,\), ... \(9 of 10\)"):
        check(torch.stack([bad] * 9 + [good]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_good_covariances_pass_whatever_their_size(dtype):
    for scale in (1e-15, 1.0, 1e12):
        check((covariance(A, B, C, D) * scale).to(dtype))
    # Sensors of very different size are well conditioned as soon as each is measured in its own unit.
    check(covariance(1e-6 * A, B, 1e6 * C, D).to(dtype))
    # Strongly correlated, yet not copies.
    check(covariance(A, A + 1e-2 * B, A + 1e-2 * C).to(dtype))
    check(torch.zeros(0, 3, 3, dtype=dtype))


def test_a_real_array_is_not_refused():
    check(torch.from_numpy(naive.wavelet_cross_covariance(naive.array(12, 400), 6)))


def test_the_error_is_a_value_error():
    assert issubclass(SingularCovarianceError, ValueError)
