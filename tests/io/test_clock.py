"""Timestamps to slots: each flaw is planted in a clean clock and has to be found, with its size."""

import numpy as np
import pytest

from gyrofuse.io.clock import Grid, grid_of
from gyrofuse.io.streams import RecordingError

RATE = 100.0


def clean(n: int = 5000) -> np.ndarray:
    return 12.5 + np.arange(n) / RATE


def grid(time: np.ndarray, **options: object) -> Grid:
    return grid_of(time, name="imu", source="log", **options)  # type: ignore[arg-type]


def numbers(result: Grid, kind: str) -> dict[str, float]:
    found = [note.numbers for note in result.notes if note.kind == kind]
    assert found, f"no note of kind {kind} in {[str(n) for n in result.notes]}"
    return found[0]


def test_clean_clock_has_nothing_to_note():
    result = grid(clean())
    assert result.notes == ()
    assert result.rate == pytest.approx(RATE, rel=1e-12)
    assert result.start == pytest.approx(12.5)
    np.testing.assert_array_equal(result.slots, np.arange(5000))


def test_gaps_become_empty_slots():
    keep = np.ones(5000, dtype=bool)
    keep[1000:1007] = keep[3000] = False
    result = grid(clean()[keep])
    np.testing.assert_array_equal(result.slots, np.flatnonzero(keep))
    assert numbers(result, "gaps") == {"gaps": 2, "samples": 8, "longest_s": pytest.approx(0.07)}


def test_repeated_timestamps_keep_the_first():
    time = clean()
    time[[100, 200]] = time[[99, 199]]
    result = grid(time)
    assert numbers(result, "repeats")["samples"] == 2
    assert result.slots.size == 4998
    assert 100 not in result.kept
    assert 99 in result.kept


def test_clock_that_steps_back():
    time = clean()
    time[2000:2003] -= 1.0
    result = grid(time)
    assert numbers(result, "clock")["samples"] == 3
    np.testing.assert_array_equal(result.kept, np.delete(np.arange(5000), [2000, 2001, 2002]))


@pytest.mark.parametrize("known", [True, False])
def test_wraps_are_unwrapped(known: bool):
    period = 2**32 * 1e-6
    time = (period - 20 + clean()) % period
    result = grid(time, clock_period=period if known else None)
    assert numbers(result, "wraps")["wraps"] == 1
    np.testing.assert_array_equal(result.slots, np.arange(5000))


def test_jitter_is_measured_and_moves_no_sample():
    rng = np.random.default_rng(0)
    result = grid(clean() + 1e-3 * rng.standard_normal(5000))
    np.testing.assert_array_equal(result.slots, np.arange(5000))
    assert result.rate == pytest.approx(RATE, rel=5e-6)  # one step in 1e6 is its standard error
    assert numbers(result, "jitter")["rms_s"] == pytest.approx(1e-3, rel=0.05)


@pytest.mark.parametrize(("jitter", "right"), [(0.01, 1.0), (0.1, 1.0), (0.2, 0.999)])
def test_jitter_with_gaps(jitter: float, right: float):
    rng = np.random.default_rng(1)
    missing = np.r_[500, 700:720, 50_000:50_700, 60_000, 60_003, 60_004]
    true = np.delete(np.arange(100_000), missing)
    result = grid((true + jitter * rng.standard_normal(true.size)) / RATE)
    found = np.full(true.size, -1)
    found[result.kept] = result.slots
    assert (found == true).mean() >= right
    assert numbers(result, "gaps")["samples"] == pytest.approx(missing.size, abs=30)


def test_many_samples_lost_at_random():
    rng = np.random.default_rng(2)
    true = np.flatnonzero(rng.random(50_000) > 0.2)
    result = grid((true + 0.03 * rng.standard_normal(true.size)) / RATE)
    np.testing.assert_array_equal(result.slots, true - true[0])
    assert result.rate == pytest.approx(RATE, rel=1e-5)


def test_late_stamps_that_catch_up_are_no_gaps():
    rng = np.random.default_rng(3)
    time = clean(50_000)
    for late in rng.integers(0, 49_900, 100):
        time[late : late + 20] = np.maximum(time[late : late + 20], time[late] + 0.15 + 0.0027 * np.arange(20))
    result = grid(np.maximum.accumulate(time))
    found = np.full(50_000, -1)
    found[result.kept] = result.slots
    assert (found == np.arange(50_000)).mean() > 0.999


def test_clock_that_was_set_back_goes_on():
    time = clean()
    time[2000:] -= 30.0
    result = grid(time)
    np.testing.assert_array_equal(result.slots, np.arange(5000))
    assert numbers(result, "clock")["seconds"] == pytest.approx(29.99)


def test_wandering_rate_loses_no_sample():
    # The rate swings by 2 % over the recording: no straight line holds it, every step does.
    n = 20_000
    step = (1 + 0.02 * np.sin(np.linspace(0, 20, n))) / RATE
    result = grid(np.cumsum(step))
    np.testing.assert_array_equal(result.slots, np.arange(n))
    assert numbers(result, "drift")["largest_s"] > 0.5 / RATE


def test_bursty_arrival_times_are_taken_in_order():
    n = 5000
    burst = np.repeat(np.arange(0, n, 10), 10) / RATE  # ten samples arrive together
    result = grid(burst)
    assert not result.trusted
    assert result.rate == pytest.approx((n - 1) / burst[-1])
    np.testing.assert_array_equal(result.kept, np.arange(n))
    assert "in order" in next(str(note) for note in result.notes)


def test_stated_rate_comes_before_the_clock():
    result = grid(clean(), rate=50.0)
    assert result.rate == 50.0
    assert numbers(result, "clock")["clock_hz"] == pytest.approx(100, rel=0.01)


def test_rate_is_exact_over_a_long_recording_of_coarse_ticks():
    # 3 h at 99.99 Hz in whole milliseconds: a rate off by 1e-6 would slip a slot.
    n = 1_080_000
    result = grid(np.rint(np.arange(n) / 99.99 * 1e3) / 1e3)
    assert result.rate == pytest.approx(99.99, rel=1e-9)
    np.testing.assert_array_equal(result.slots, np.arange(n))


@pytest.mark.parametrize("time", [np.zeros(100), np.full(100, np.nan), np.array([1.0]), np.arange(100, 0, -1.0)])
def test_clocks_that_say_nothing(time: np.ndarray):
    with pytest.raises(RecordingError, match="expected timestamps that advance"):
        grid(time)


def test_jump_of_the_clock_is_no_recording():
    time = clean()
    time[2500:] += 1e6
    with pytest.raises(RecordingError, match="cut the log where the clock jumps"):
        grid(time)


def test_log_sorted_backwards_is_refused_at_once():
    with pytest.raises(RecordingError, match="mostly run backwards in imu; sort the log"):
        grid(-np.arange(100_000) / RATE)


def test_stated_rate_that_the_clock_contradicts_is_noted():
    result = grid(clean(), nominal=250.0)
    assert result.rate == pytest.approx(RATE)
    assert numbers(result, "clock")["stated_hz"] == 250.0
    assert grid(clean(), nominal=100.2).notes == ()
