"""Devices with clocks of their own on one grid."""

import numpy as np
import pytest

from gyrofuse.io.align import align
from gyrofuse.io.clock import grid_of, regular_grid
from gyrofuse.io.streams import RecordingError


def device(start: float, n: int, rate: float = 100.0):
    return grid_of(start + np.arange(n) / rate, name="imu", source="log")


def test_offset_and_cut_are_reported_and_samples_kept():
    # b starts 0.253 s after a and ends 1.0 s before it
    a, b = device(5.0, 1000), device(5.253, 874)
    placed, rate, notes = align([a, b], ["a", "b"], "a.csv, b.csv")
    assert rate == pytest.approx(100)
    assert placed[0].n_slots == placed[1].n_slots == 874
    np.testing.assert_array_equal(placed[0].kept, np.arange(25, 899))
    np.testing.assert_array_equal(placed[1].kept, np.arange(874))
    offset = next(note for note in notes if note.kind == "offset")
    assert offset.numbers["offset_s"] == pytest.approx(0.253)
    assert offset.numbers["residual_s"] == pytest.approx(0.003, abs=1e-9)
    cut = next(note for note in notes if note.kind == "cut")
    assert cut.stream == "a"
    assert cut.numbers == {"start_samples": 25, "end_samples": 101}


def test_slipping_clock_is_followed_and_reported():
    a, b = device(0.0, 100_000), device(0.0, 100_000, rate=100.005)  # slips five samples
    placed, _, notes = align([a, b], ["a", "b"], "log")
    drift = next(note for note in notes if note.kind == "drift")
    assert abs(drift.numbers["samples"]) == pytest.approx(5, abs=0.01)
    time_of_a = placed[0].kept / 100.0
    on_b = np.full(placed[1].n_slots, np.nan)
    on_b[placed[1].slots] = placed[1].kept / 100.005
    known = np.isfinite(on_b)
    assert np.abs(on_b[known] - time_of_a[known]).max() <= 0.0051


def test_without_timestamps_devices_start_together():
    placed, _, notes = align([regular_grid(100, 50.0), regular_grid(90, 50.0)], ["a", "b"], "log")
    assert placed[0].n_slots == 90
    assert any("start at their first samples" in str(note) for note in notes)
    assert any(note.kind == "cut" and note.numbers["end_samples"] == 10 for note in notes)


def test_no_overlap():
    with pytest.raises(RecordingError, match=r"clocks that do not overlap \(a 0 to 9.99 s; b 20 to 29.99 s\)"):
        align([device(0.0, 1000), device(20.0, 1000)], ["a", "b"], "log")


def test_different_rates():
    with pytest.raises(RecordingError, match="found 100 Hz in a and 120 Hz in b"):
        align([device(0.0, 1000), device(0.0, 1000, rate=120.0)], ["a", "b"], "log")
