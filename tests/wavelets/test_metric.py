"""The streaming metric: any chunks, any number of processes, the same sums."""

from __future__ import annotations

import copy
import itertools
import pickle
import socket
import warnings
from collections import deque
from pathlib import Path

import numpy as np
import pytest
import torch
from reference import haar as naive
from torch import distributed

from gyrofuse import WaveletCrossCovariance, wavelet_cross_covariance
from gyrofuse.wavelets import tiles as _tiles

N_SENSORS, N_LEVELS = 3, 9


def recording(n_samples: int, *, gaps: bool = False) -> torch.Tensor:
    signal = naive.array(N_SENSORS, n_samples) + 250 + 1e-3 * np.arange(n_samples)
    if gaps:
        # Across the borders of chunks of 7 and 777 samples and of tiles of 16, and one far from any other.
        signal[0, 15:17] = np.nan
        signal[1, 770:790] = np.nan
        signal[2, 1300:1301] = np.inf
        signal[:, 2100:2103] = np.nan
    return torch.from_numpy(signal)


def one_shot(signal: torch.Tensor) -> torch.Tensor:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "no complete window")
        return wavelet_cross_covariance(signal, N_LEVELS)


def streamed(signal: torch.Tensor, length: int, *, look_every: int | None = None) -> torch.Tensor:
    """Chunks of `length` samples; the result so far is asked for now and then and must not disturb."""
    metric = WaveletCrossCovariance(N_SENSORS, N_LEVELS)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "no complete window")
        for i, chunk in enumerate(signal.split(length, dim=-1)):
            metric.update(chunk)
            if look_every is not None and i % look_every == 0 and metric.n_samples > 1:
                metric.compute()
        return metric.compute()


@pytest.mark.parametrize("small_tiles", [False, True], ids=["usual_tiles", "small_tiles"])
@pytest.mark.parametrize("gaps", [False, True], ids=["complete", "gaps"])
@pytest.mark.parametrize(("length", "look_every"), [(1, None), (1, 500), (7, 50), (777, None), (777, 1), (10**6, 1)])
def test_chunks_of_any_length_equal_one_shot(monkeypatch, length, look_every, gaps, small_tiles):
    signal = recording(2500, gaps=gaps)
    expected = naive.wavelet_cross_covariance(signal.numpy(), N_LEVELS)
    if small_tiles:
        monkeypatch.setattr(_tiles, "_CPU_TILE", 1)
    got = streamed(signal, length, look_every=look_every)
    assert naive.relative_error(got, expected) < 1e-10
    assert naive.relative_error(got, one_shot(signal)) < 1e-10


def test_the_result_so_far_is_that_of_the_samples_so_far(monkeypatch):
    monkeypatch.setattr(_tiles, "_CPU_TILE", 3 * 64)
    signal = recording(900, gaps=True)
    metric = WaveletCrossCovariance(N_SENSORS, 5)
    for start in range(0, 900, 50):
        metric.update(signal[:, start : start + 50])
        expected = naive.wavelet_cross_covariance(signal[:, : start + 50].numpy(), 5)
        assert naive.relative_error(metric.compute(), expected) < 1e-10
        assert metric.n_samples == start + 50


def test_nothing_taken_in_is_nan_and_says_so():
    metric = WaveletCrossCovariance(N_SENSORS, 4)
    metric.update(recording(600)[:, :1])
    with pytest.warns(UserWarning, match="fewer than two samples in a row taken in so far"):
        assert metric.compute().isnan().all()


def test_forward_gives_the_result_so_far():
    signal = recording(600)
    metric = WaveletCrossCovariance(N_SENSORS, 4)
    for end in (200, 400, 600):
        got = metric(signal[:, end - 200 : end])
        assert naive.relative_error(got, wavelet_cross_covariance(signal[:, :end], 4)) < 1e-10


def test_a_chunk_without_samples_changes_nothing():
    signal = recording(600)
    metric = WaveletCrossCovariance(N_SENSORS, 4)
    for chunk in (signal[:, :0], signal[:, :301], signal[:, :0], signal[:, 301:], signal[:, :0]):
        metric.update(chunk)
    assert naive.relative_error(metric.compute(), wavelet_cross_covariance(signal, 4)) < 1e-10
    assert metric.n_samples == 600


def test_reset_forgets_the_past():
    first, second = recording(500), recording(700)
    metric = WaveletCrossCovariance(N_SENSORS, 4)
    metric.update(first)
    metric.compute()
    metric.reset()
    assert metric.n_samples == 0
    metric.update(second)
    assert naive.relative_error(metric.compute(), wavelet_cross_covariance(second, 4)) < 1e-10


@pytest.mark.parametrize("again", [copy.deepcopy, lambda metric: pickle.loads(pickle.dumps(metric))])
def test_a_copy_goes_on_by_itself(again):
    signal = recording(900)
    metric = WaveletCrossCovariance(N_SENSORS, N_LEVELS)
    metric.update(signal[:, :400])
    other = again(metric)
    metric.update(signal[:, 400:])
    other.update(signal[:, 400:650])
    assert naive.relative_error(metric.compute(), one_shot(signal)) < 1e-10
    assert naive.relative_error(other.compute(), one_shot(signal[:, :650])) < 1e-10


@pytest.mark.parametrize("cuts", [[0, 1300, 2500], [0, 200, 2500], [0, 600, 1200, 1800, 2500]])
def test_stretches_of_time_add_up(cuts):
    """Each stretch is primed with the samples before it; a gap lies across one of the seams."""
    signal = recording(2500, gaps=True)
    signal[1, 1290:1310] = torch.nan
    parts = []
    for start, end in itertools.pairwise(cuts):
        part = WaveletCrossCovariance(N_SENSORS, N_LEVELS)
        if start:
            part.prime(signal[:, max(0, start - 2**N_LEVELS + 1) : start])
        for chunk in signal[:, start:end].split(333, dim=-1):
            part.update(chunk)
        parts.append(part)
    whole = parts[0]
    for part in parts[1:]:
        whole.merge_state(part)
    assert naive.relative_error(whole.compute(), one_shot(signal)) < 1e-10


def test_a_merged_metric_goes_on():
    signal = recording(1500)
    first, second = (WaveletCrossCovariance(N_SENSORS, 6) for _ in range(2))
    first.update(signal[:, :700])
    first.compute()
    second.prime(signal[:, 700 - 63 : 700])
    second.update(signal[:, 700:1000])
    second.merge_state(first)
    assert naive.relative_error(second.compute(), wavelet_cross_covariance(signal[:, :1000], 6)) < 1e-10
    second.update(signal[:, 1000:])
    assert naive.relative_error(second.compute(), wavelet_cross_covariance(signal, 6)) < 1e-10


def one_of_two(rank: int, port: int, folder: str) -> None:
    """One process of the distributed test: its half of the recording, primed with the end of the other's."""
    torch.set_num_threads(1)  # a fork has none of the other threads
    distributed.init_process_group("gloo", init_method=f"tcp://127.0.0.1:{port}", rank=rank, world_size=2)
    try:
        signal = recording(2500, gaps=True)
        metric = WaveletCrossCovariance(N_SENSORS, N_LEVELS)
        if rank == 1:
            metric.prime(signal[:, 1200 - 2**N_LEVELS + 1 : 1200])
        for chunk in (signal[:, :1200], signal[:, 1200:])[rank].split(500, dim=-1):
            metric.update(chunk)
        results = [metric.compute()]
        # Synchronising must not count the other's part twice when it happens again.
        metric.update(signal[:, :0])
        results.append(metric.compute())
        torch.save(torch.stack(results), Path(folder) / f"{rank}.pt")
    finally:
        distributed.destroy_process_group()


@pytest.mark.skipif(not distributed.is_available(), reason="this torch is built without torch.distributed")
def test_two_processes_equal_one(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    torch.multiprocessing.start_processes(one_of_two, (port, str(tmp_path)), nprocs=2, start_method="fork")
    expected = one_shot(recording(2500, gaps=True))
    for rank in range(2):
        for result in torch.load(tmp_path / f"{rank}.pt"):
            assert naive.relative_error(result, expected) < 1e-10


def tensors_in(thing: object) -> list[torch.Tensor]:
    """All tensors that an object of the library holds, in whatever containers."""
    if isinstance(thing, torch.Tensor):
        return [thing]
    if isinstance(thing, dict):
        thing = thing.values()
    elif type(thing).__module__.startswith("gyrofuse"):
        thing = vars(thing).values()
    elif not isinstance(thing, (list, tuple, deque)):
        return []
    return [tensor for part in thing for tensor in tensors_in(part)]


def test_memory_does_not_grow_with_the_recording(monkeypatch):
    tile, n_levels = 64, 8
    monkeypatch.setattr(_tiles, "_CPU_TILE", N_SENSORS * tile // torch.get_num_threads())
    metric = WaveletCrossCovariance(N_SENSORS, n_levels)
    chunk = torch.from_numpy(naive.array(N_SENSORS, 500))
    sizes = []
    for _ in range(12):
        metric.update(chunk)
        metric.compute()
        storages = [tensor.untyped_storage() for tensor in tensors_in(metric)]
        sizes.append(sum({storage.data_ptr(): storage.nbytes() for storage in storages}.values()))
    assert sizes[2:] == sizes[2:3] * 10
    # What the wavelets need of the past, a few tiles, and the sums.
    past = 8 * N_SENSORS * 2**n_levels
    assert past < sizes[-1] < past + 8 * N_SENSORS * (6 * tile + 10 * n_levels * N_SENSORS)


def test_float32_arithmetic():
    signal = recording(2500)
    metric = WaveletCrossCovariance(N_SENSORS, N_LEVELS, dtype=torch.float32)
    for chunk in signal.split(300, dim=-1):
        metric.update(chunk)
    got = metric.compute()
    assert got.dtype == torch.float32
    assert metric.sums.dtype == torch.float64
    assert naive.relative_error(got, one_shot(signal)) < 3e-3


def test_gradients_are_not_recorded():
    metric = WaveletCrossCovariance(N_SENSORS, 3)
    metric.update(recording(100).requires_grad_())
    assert not metric.compute().requires_grad


def test_a_level_without_any_complete_window_is_nan_and_said():
    metric = WaveletCrossCovariance(N_SENSORS, 4)
    metric.update(recording(9))
    with pytest.warns(UserWarning, match=r"no complete window for some sensors at level\(s\) \[4\]"):
        got = metric.compute()
    assert got[:3].isfinite().all()
    assert got[3].isnan().all()


def test_bad_chunks_are_named():
    metric = WaveletCrossCovariance(N_SENSORS, 4)
    with pytest.raises(TypeError, match=r"`chunk`: expected float32 or float64, got torch.int32"):
        metric.update(torch.zeros(N_SENSORS, 10, dtype=torch.int32))
    with pytest.raises(ValueError, match=r"`chunk`: expected \(sensor, time\) with 3 sensors, got shape \(2, 10\)"):
        metric.update(torch.zeros(2, 10))
    with pytest.raises(ValueError, match=r"`chunk`: expected \(sensor, time\) with 3 sensors, got shape \(1, 3, 10\)"):
        metric.update(torch.zeros(1, N_SENSORS, 10))
    with pytest.raises(ValueError, match=r"`history`: expected \(sensor, time\) with 3 sensors, got shape \(4, 10\)"):
        metric.prime(torch.zeros(4, 10))
    assert metric.n_samples == 0
    metric.update(torch.zeros(N_SENSORS, 10))
    with pytest.raises(RuntimeError, match=r"`prime` comes before the first `update`; call reset\(\)"):
        metric.prime(torch.zeros(N_SENSORS, 10))
    with pytest.raises(ValueError, match="`chunk`: expected device cpu as before, got meta"):
        metric.update(torch.zeros(N_SENSORS, 10, device="meta"))


@pytest.mark.parametrize(("name", "n_sensors", "n_levels"), [("n_sensors", 0, 3), ("n_levels", 3, 1.5)])
def test_bad_sizes_are_named(name, n_sensors, n_levels):
    with pytest.raises(ValueError, match=f"`{name}`: expected a whole number >= 1"):
        WaveletCrossCovariance(n_sensors, n_levels)
