"""Recordings that are read by stretches: whole or in stretches, from a file or made up, the same weights."""

from __future__ import annotations

import itertools
import json
import os
import pickle
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
import torch
from logs import write_hdf5, write_parquet
from reference import haar as naive
from torch import distributed

import gyrofuse as gf
from gyrofuse.fusion.streaming import measure_stretch
from gyrofuse.io import chunked, recording, shard_bounds

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "long_recording.py"
N_SENSORS, N_SAMPLES, N_LEVELS = 4, 5000, 7


def samples(*, gaps: bool = False) -> torch.Tensor:
    signal = naive.array(N_SENSORS, N_SAMPLES) + 30
    if gaps:  # across the seams of two and of three stretches, and elsewhere
        signal[0, 2490:2510] = np.nan
        signal[1, 1660:1667] = np.inf
        signal[2, 3333:3334] = np.nan
        signal[:, 4000:4100] = np.nan
    return torch.from_numpy(signal)


def recording_of(signal: torch.Tensor, **about: object) -> gf.ChunkedRecording:
    return gf.ChunkedRecording(lambda start, stop: signal[:, start:stop], *signal.shape, **about)


def launched(rank: int = 0, world_size: int = 1) -> SimpleNamespace:
    """What is used of a `Fabric`."""
    return SimpleNamespace(global_rank=rank, world_size=world_size, device=torch.device("cpu"), barrier=lambda: None)


@pytest.mark.parametrize("n_samples", [1, 7, 100, 101])
@pytest.mark.parametrize("world_size", [1, 2, 3, 8])
def test_stretches_follow_each_other(n_samples: int, world_size: int):
    stretches = [shard_bounds(n_samples, rank, world_size) for rank in range(world_size)]
    assert stretches[0][0] == 0
    assert stretches[-1][1] == n_samples
    assert all(before[1] == after[0] for before, after in itertools.pairwise(stretches))
    lengths = [stop - start for start, stop in stretches]
    assert max(lengths) - min(lengths) <= 1


@pytest.mark.parametrize("gaps", [False, True], ids=["complete", "gaps"])
@pytest.mark.parametrize("chunk_samples", [1, 333, 4999, 10**6, None])
def test_chunks_of_any_length_give_the_weights_of_the_whole(chunk_samples: int | None, gaps: bool):
    signal = samples(gaps=gaps)
    result = gf.stream_svo(recording_of(signal), "long", N_LEVELS, chunk_samples=chunk_samples)
    expected = naive.wavelet_cross_covariance(signal.numpy(), N_LEVELS)
    assert naive.relative_error(result.wavelet_cross_covariance, expected) < 1e-12
    whole = gf.svo_weights(gf.wavelet_cross_covariance(signal, N_LEVELS), "long")
    torch.testing.assert_close(result.weights, whole, rtol=1e-12, atol=1e-14)
    assert result.n_samples == N_SAMPLES


@pytest.mark.parametrize("gaps", [False, True], ids=["complete", "gaps"])
@pytest.mark.parametrize("world_size", [2, 3])
def test_stretches_add_up(world_size: int, gaps: bool):
    signal = samples(gaps=gaps)
    parts = [
        measure_stretch(recording_of(signal), N_LEVELS, *shard_bounds(N_SAMPLES, rank, world_size), chunk_samples=97)
        for rank in range(world_size)
    ]
    for part in parts[1:]:
        parts[0].merge_state(part)
    whole = gf.WaveletCrossCovariance(N_SENSORS, N_LEVELS)
    whole.update(signal)
    assert naive.relative_error(parts[0].compute(), whole.compute()) < 1e-12
    torch.testing.assert_close(parts[0].counts, whole.counts, rtol=0, atol=0)


def test_a_process_reads_its_stretch_and_what_it_looks_back_on():
    signal, read = samples(), []

    def source(start: int, stop: int) -> torch.Tensor:
        read.append((start, stop))
        return signal[:, start:stop]

    recording = gf.ChunkedRecording(source, N_SENSORS, N_SAMPLES)
    measure_stretch(recording, N_LEVELS, 2000, 3000, chunk_samples=300)
    assert read[0][0] == 2000 - 2**N_LEVELS + 1
    assert read[-1][1] == 3000
    assert all(before[1] == after[0] for before, after in itertools.pairwise(read))
    assert max(stop - start for start, stop in read) == 300


def test_two_processes(tmp_path: Path):
    """The example, started by Fabric: its check, its file and its printed weights are those of one process."""
    command = [sys.executable, str(EXAMPLE), "--samples", "50001", "--levels", "12", "--chunk", "9999", "--check"]
    printed = {}
    for devices in (1, 2):
        more = ["--devices", str(devices), "--out", f"{devices}.npy"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        done = subprocess.run([*command, *more], capture_output=True, text=True, cwd=tmp_path, env=environment)
        assert done.returncode == 0, done.stderr
        assert f"by {devices} process(es)" in done.stdout
        printed[devices] = done.stdout
        differences = [float(done.stdout.split(word)[1].split()[0].strip(".,")) for word in ("a weight", "variances,")]
        assert max(differences) < 1e-12
    table, again = (text.split(" values in ")[0].rpartition("\n")[0] for text in printed.values())
    assert table == again
    one, two = (np.load(tmp_path / f"{devices}.npy") for devices in (1, 2))
    assert one.shape == (50001,)
    np.testing.assert_allclose(two, one, rtol=0, atol=1e-12 * np.abs(one).max())
    assert {path.name for path in tmp_path.iterdir()} == {"1.npy", "2.npy"}


def test_processes_that_were_not_started_are_refused():
    with pytest.raises(RuntimeError, match=r"`fabric`: expected 2 processes .* call fabric.launch\(\) first"):
        gf.stream_svo(recording_of(samples()), fabric=launched(1, 2))
    alone = gf.stream_svo(recording_of(samples()), n_levels=3, fabric=launched())
    assert torch.equal(alone.weights, gf.stream_svo(recording_of(samples()), n_levels=3).weights)


def test_levels_by_default():
    signal = samples()
    assert gf.stream_svo(recording_of(signal)).n_levels == 12  # 2**12 <= 5000
    assert gf.stream_svo(recording_of(signal), [1.0, 0.0, 2.0]).scale_weights.tolist() == [1 / 3, 0, 2 / 3]
    signal[0, ::700] = torch.nan  # no window of 2**10 is complete
    result = gf.stream_svo(recording_of(signal))
    assert result.n_levels == 9
    assert torch.equal(result.weights, gf.stream_svo(recording_of(signal), n_levels=9).weights)


def test_memory_bounds_the_levels(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("gyrofuse.fusion.streaming._PAST", N_SENSORS * 64)
    assert gf.stream_svo(recording_of(samples())).n_levels == 6
    assert gf.stream_svo(recording_of(samples()), n_levels=8).n_levels == 8


def test_progress_ends_at_one():
    told: list[tuple[str, float]] = []
    measure_stretch(recording_of(samples()), 9, 2500, 5000, chunk_samples=200, progress=lambda *what: told.append(what))
    shares = [share for _, share in told]
    assert [what for what, _ in itertools.groupby(what for what, _ in told)] == ["looking back", "streaming"]
    assert shares == sorted(shares)
    assert shares[-1] == 1
    assert len({*shares}) == len(shares)


def test_the_result_says_what_a_fit_in_memory_says():
    signal = samples()
    fitted = gf.fit_svo(gf.Recording(signal, rate=50.0, unit="deg/s"), "short", covariance="none")
    result = gf.stream_svo(recording_of(signal, rate=50.0, unit="deg/s"), "short")
    assert str(result) == result.summary()
    assert "4 sensors, 5000 samples, 50 Hz" in str(result)
    table = "Allan deviation (deg/s)"
    # What both print of each level is the same but for the virtual gyro, which is judged where its weights come from.
    own, other = (text.split(table)[1].split("\n\n")[0].splitlines() for text in (str(result), fitted.summary()))
    assert "virtual gyro in this recording" in own[0]
    assert "virtual gyro in other recordings" in other[0]
    assert [line.split()[:5] for line in own[1:]] == [line.split()[:5] for line in other[1:]]
    torch.testing.assert_close(result.virtual(signal), fitted.virtual(signal), rtol=1e-12, atol=1e-12)
    values = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    told = fitted.to_dict()
    told["virtual_wavelet_variance"] = told["in_sample_wavelet_variance"]
    for name in ("weights", "scale_weights", "tau", "virtual_wavelet_variance", "wavelet_cross_covariance"):
        np.testing.assert_allclose(values[name], told[name], rtol=1e-9, atol=1e-12)
    axes = result.plot(matplotlib.figure.Figure().subplots())
    assert "virtual gyro" in [text.get_text() for text in axes.get_legend().get_texts()]


def saved(path: Path, signal: np.ndarray) -> Path:
    """A log of the format that the suffix says."""
    if path.suffix == ".npy":
        np.save(path, signal)
    elif path.suffix == ".npz":
        np.savez(path, fs=100.0, other=signal[:, :3], gyro=signal, unit="deg/s", sensors=list("abcd"))
    elif path.suffix == ".h5":
        write_hdf5(path, {"imu": {"gyro": (signal, {"unit": "deg/s"}), "temperature": signal[0]}}, fs=100.0)
    else:
        pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
        columns = {f"gyro_{name}": row for name, row in zip("abcd", signal, strict=True)}
        table = pa.table({"time": np.arange(signal.shape[1]), **columns})
        parquet.write_table(table.replace_schema_metadata({"fs": "100", "unit": "deg/s"}), path, row_group_size=777)
    return path


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".h5", ".parquet"])
def test_files(tmp_path: Path, suffix: str):
    signal = samples(gaps=True).numpy()
    recording = gf.open_recording(saved(tmp_path / f"log{suffix}", signal))
    assert (recording.n_sensors, recording.n_samples) == signal.shape
    for start, stop in ((0, 1), (700, 1700), (776, 777), (2480, 2520), (4999, 5000), (0, 5000), (10, 10)):
        got = recording.read(start, stop)
        assert got.dtype == torch.float64
        np.testing.assert_array_equal(got.numpy(), signal[:, start:stop])
    if suffix != ".npy":
        assert (recording.rate, recording.unit) == (100.0, "deg/s")
        assert "5000 samples at 100 Hz (50 s), deg/s" in str(recording)
    names = {".npz": "abcd", ".parquet": ["gyro_a", "gyro_b", "gyro_c", "gyro_d"]}
    assert recording.sensors == tuple(names.get(suffix, "1234"))
    assert gf.open_recording(tmp_path / f"log{suffix}", rate=7.0, unit="rad/s").rate == 7.0
    again = pickle.loads(pickle.dumps(recording))  # for processes that are sent it
    np.testing.assert_array_equal(again.read(5, 9).numpy(), signal[:, 5:9])


@pytest.mark.parametrize("kind", ["time first", "Fortran order", "float32", "int16", "big-endian"])
@pytest.mark.parametrize("suffix", [".npy", ".npz", ".h5"])
def test_arrays_of_other_layouts(tmp_path: Path, kind: str, suffix: str):
    values = np.round(100 * samples()[:3].numpy())
    stored = {
        "time first": lambda: values.T.copy(),
        "Fortran order": lambda: np.asfortranarray(values),
        "float32": lambda: values.astype(np.float32),
        "int16": lambda: values.astype(np.int16),
        "big-endian": lambda: values.astype(">f8"),
    }[kind]()
    path = tmp_path / f"log{suffix}"
    if suffix == ".h5":
        write_hdf5(path, {"angular": stored})
    else:
        (np.save if suffix == ".npy" else np.savez)(path, stored)
    recording = gf.open_recording(path)
    assert recording.n_sensors == 3
    np.testing.assert_array_equal(recording.read(100, 3000).numpy(), values[:, 100:3000])
    assert (recording.rate, recording.unit) == (None, "unknown")


def test_names_of_arrays_and_columns(tmp_path: Path):
    signal = samples().numpy()
    np.savez(tmp_path / "a.npz", first=signal, second=-signal)
    np.testing.assert_array_equal(gf.open_recording(tmp_path / "a.npz", key="second").read(3, 5), -signal[:, 3:5])
    with pytest.raises(
        gf.RecordingError, match=r"a.npz: expected one array .* found first .* name the gyros with `key`"
    ):
        gf.open_recording(tmp_path / "a.npz")
    saved(tmp_path / "a.parquet", signal)
    two = gf.open_recording(tmp_path / "a.parquet", key=["gyro_c", "gyro_a"])
    np.testing.assert_array_equal(two.read(700, 800), signal[[2, 0], 700:800])
    with pytest.raises(gf.RecordingError, match=r"expected columns \['gyro_e'\] \(`key`\) of numbers"):
        gf.open_recording(tmp_path / "a.parquet", key="gyro_e")


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".parquet"])
def test_accelerometers_of_a_log_of_both(tmp_path: Path, suffix: str):
    rates = samples().numpy()
    accelerations = 2 * rates[:3] + 9.75
    path = tmp_path / f"log{suffix}"
    if suffix == ".npz":
        np.savez(path, gyro=rates, acceleration=accelerations, fs=100.0, unit="deg/s")
    elif suffix == ".h5":
        stated = {"gyro": (rates, {"unit": "deg/s"}), "acceleration": (accelerations, {"unit": "m/s^2"})}
        write_hdf5(path, {"imu": stated}, fs=100.0)
    else:
        columns = {f"gyro_{n}": row for n, row in zip("abcd", rates, strict=True)}
        columns |= {f"acc_{n} [m/s^2]": row for n, row in zip("abc", accelerations, strict=True)}
        write_parquet(path, columns, {"fs": "100", "unit": "deg/s"})
    recording = gf.open_recording(path, quantity="acceleration")
    # of an .npz the one unit is that of the gyros
    assert (recording.rate, recording.unit) == (100.0, "unknown" if suffix == ".npz" else "m/s^2")
    np.testing.assert_array_equal(recording.read(700, 1700).numpy(), accelerations[:, 700:1700])
    gyros = gf.open_recording(path)
    assert gyros.unit == "deg/s"
    np.testing.assert_array_equal(gyros.read(700, 1700).numpy(), rates[:, 700:1700])


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".parquet"])
def test_a_long_log_of_accelerometers_alone(tmp_path: Path, suffix: str):
    accelerations = samples().numpy()[:3]
    path = tmp_path / f"log{suffix}"
    if suffix == ".parquet":
        write_parquet(path, {f"acc_{axis}": row for axis, row in zip("xyz", accelerations, strict=True)})
    elif suffix == ".h5":
        write_hdf5(path, {"accelerometer": accelerations})
    else:
        np.savez(path, acc=accelerations)
    found = gf.open_recording(path, quantity="acceleration").read(3, 5)
    np.testing.assert_array_equal(found.numpy(), accelerations[:, 3:5])
    with pytest.raises(gf.RecordingError, match=r'it has accelerations, .* with quantity="acceleration"'):
        gf.open_recording(path)


def test_no_such_quantity(tmp_path: Path):
    with pytest.raises(ValueError, match=r"`quantity`: expected 'rate' or 'acceleration', got 'force'"):
        gf.open_recording(saved(tmp_path / "log.npy", samples().numpy()), quantity="force")


def test_what_cannot_be_read_by_stretches_is_refused(tmp_path: Path):
    signal = samples().numpy()
    np.savez_compressed(tmp_path / "packed.npz", gyro=signal)
    with pytest.raises(
        gf.RecordingError, match=r"packed.npz: expected `gyro` as it is, found it compressed.*np.savez or"
    ):
        gf.open_recording(tmp_path / "packed.npz")
    np.save(tmp_path / "deep.npy", signal[None])
    with pytest.raises(gf.RecordingError, match=r"deep.npy: expected the array to be numbers \(sensor, time\)"):
        gf.open_recording(tmp_path / "deep.npy")
    np.save(tmp_path / "cut.npy", signal)
    os.truncate(tmp_path / "cut.npy", 10_000)
    with pytest.raises(gf.RecordingError, match=r"cut.npy: expected a .npy file, found one that cannot be read"):
        gf.open_recording(tmp_path / "cut.npy")
    with pytest.raises(gf.RecordingError, match=r"log.csv: expected one of .npy, .* found '.csv'; save it as .npy"):
        gf.open_recording(tmp_path / "log.csv")
    with pytest.raises(FileNotFoundError, match=r"absent.npy: no such file"):
        gf.open_recording(tmp_path / "absent.npy")
    with pytest.raises(gf.RecordingError, match=r"expected no `key` for an .npy file"):
        gf.open_recording(tmp_path / "deep.npy", key="gyro")


def one_of_two(rank: int, port: int, folder: str) -> None:
    """One process that writes its half of three virtual gyros and says what came of it: none, 0 or 1 fails halfway.

    And what came of measuring the recording: nobody waits for one that failed.
    """
    torch.set_num_threads(1)  # a fork has none of the other threads
    distributed.init_process_group("gloo", init_method=f"tcp://127.0.0.1:{port}", rank=rank, world_size=2)
    signal, fabric = samples(), launched(rank, 2)
    fabric.barrier = distributed.barrier
    try:
        for failing in (None, 0, 1):

            def source(start: int, stop: int, failing: int | None = failing) -> torch.Tensor:
                if rank == failing and start % 2500 > 1000:
                    raise OSError("the disk is gone")
                return signal[:, start:stop]

            path, said = Path(folder, f"{failing}.npy"), "nothing"
            recording = gf.ChunkedRecording(source, N_SENSORS, N_SAMPLES)
            try:
                gf.write_virtual(recording, torch.ones(4).double() / 4, path, chunk_samples=300, fabric=fabric)
                assert np.load(path).shape == (N_SAMPLES,)  # there as soon as this process goes on
            except (OSError, RuntimeError) as error:
                said = f"{type(error).__name__}: {error}"
            Path(folder, f"{failing} {rank}.txt").write_text(said)
            try:
                weights = gf.stream_svo(recording, n_levels=3, chunk_samples=300, fabric=fabric).weights
                measured = f"{len(weights)} weights"
            except (OSError, RuntimeError) as error:
                measured = f"{type(error).__name__}: {error}"
            Path(folder, f"{failing} {rank} measured.txt").write_text(measured)
    finally:
        distributed.destroy_process_group()


@pytest.mark.skipif(not distributed.is_available(), reason="this torch is built without torch.distributed")
def test_two_processes_are_both_done_or_both_told(tmp_path: Path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    torch.multiprocessing.start_processes(one_of_two, (port, str(tmp_path)), nprocs=2, start_method="fork")
    said = {path.stem: path.read_text() for path in tmp_path.glob("*.txt")}
    assert said["None 0"] == said["None 1"] == "nothing"
    assert said["None 0 measured"] == said["None 1 measured"] == "4 weights"
    np.testing.assert_allclose(np.load(tmp_path / "None.npy"), samples().mean(0).numpy(), rtol=1e-13)
    for failing in (0, 1):
        assert said[f"{failing} {failing}"] == "OSError: the disk is gone"
        assert f"was not written, for process(es) {failing} of 2 failed" in said[f"{failing} {1 - failing}"]
        assert said[f"{failing} {failing} measured"] == "OSError: the disk is gone"
        assert f"read to its end, for process(es) {failing} of 2" in said[f"{failing} {1 - failing} measured"]
    assert {path.name for path in tmp_path.iterdir()} == {"None.npy", *(f"{name}.txt" for name in said)}


def test_bad_recordings_are_named():
    signal = samples()
    with pytest.raises(TypeError, match=r"`source`: expected a function of \(start, stop\), got str"):
        gf.ChunkedRecording("log.npy", 2, 10)
    with pytest.raises(ValueError, match="`n_samples`: expected a whole number >= 1, got 0"):
        gf.ChunkedRecording(lambda *_: signal, 2, 0)
    with pytest.raises(ValueError, match="`sensors`: expected 4 names, got 2"):
        recording_of(signal, sensors=("a", "b"))
    with pytest.raises(ValueError, match="`rate`: expected a finite number > 0"):
        recording_of(signal, rate=0.0)
    with pytest.raises(ValueError, match="`stop`: expected start <= stop <= 5000"):
        recording_of(signal).read(4000, 5001)
    wrong = gf.ChunkedRecording(lambda start, stop: signal[:3, start:stop], N_SENSORS, N_SAMPLES)
    with pytest.raises(ValueError, match=r"`source`: expected \(sensor, time\) of shape \(4, 10\) .* got \(3, 10\)"):
        wrong.read(0, 10)
    with pytest.raises(TypeError, match=r"`source`: expected real numbers, got torch\.bool"):
        gf.ChunkedRecording(lambda start, stop: signal[:, start:stop] > 0, N_SENSORS, N_SAMPLES).read(0, 10)
    with pytest.raises(ValueError, match="`rank`: expected a whole number from 0 to 1, got 2"):
        shard_bounds(10, 2, 2)


def test_bad_fits_are_named():
    signal = samples()
    with pytest.raises(TypeError, match="`recording`: expected a ChunkedRecording, got Tensor"):
        gf.stream_svo(signal)
    with pytest.raises(ValueError, match="`recording`: expected at least 2 sensors to fuse, got 1"):
        gf.stream_svo(recording_of(signal[:1]))
    with pytest.raises(ValueError, match="`n_levels`: expected at most 5 for 40 samples"):
        gf.stream_svo(recording_of(signal[:, :40]), n_levels=6)
    with pytest.raises(ValueError, match=r"expected at least as many windows .* \(4\), got 2; record longer"):
        gf.stream_svo(recording_of(signal[:, :3]))
    with pytest.raises(ValueError, match="`chunk_samples`: expected a whole number >= 1, got 0"):
        gf.stream_svo(recording_of(signal), chunk_samples=0)
    nothing = gf.ChunkedRecording(lambda *_: pytest.fail("was read before the options were looked at"), 4, N_SAMPLES)
    with pytest.raises(ValueError, match="`scale_weights`: expected 'flat'"):
        gf.stream_svo(nothing, "broad")
    twice = torch.cat([signal, signal[:1]])
    with pytest.raises(gf.SingularCovarianceError, match="sensors 1 and 5 are copies"):
        gf.stream_svo(recording_of(twice))


def test_the_virtual_gyro_as_a_file(tmp_path: Path):
    signal = samples(gaps=True)
    weights = gf.stream_svo(recording_of(signal), n_levels=5).weights
    path = tmp_path / "virtual.npy"
    told = []
    gf.write_virtual(
        recording_of(signal), weights, path, chunk_samples=321, progress=lambda _, share: told.append(share)
    )
    got = np.load(path)
    np.testing.assert_allclose(got, weights.numpy() @ signal.numpy(), rtol=1e-13)
    assert np.isnan(got[4050])
    assert told[-1] == 1
    with pytest.raises(FileExistsError, match=r"virtual.npy: exists already"):
        gf.write_virtual(recording_of(signal), weights, path)
    gf.write_virtual(recording_of(signal), torch.full((4,), 0.25).double(), path, force=True)
    np.testing.assert_allclose(np.load(path), signal.mean(0).numpy(), rtol=1e-13)
    with pytest.raises(ValueError, match=r"`path`: expected a name that ends in .npy, got 'a.npz'"):
        gf.write_virtual(recording_of(signal), weights, tmp_path / "a.npz")
    with pytest.raises(ValueError, match=r"`weights`: expected one for each of 4 sensors, got shape \(3,\)"):
        gf.write_virtual(recording_of(signal), weights[:3], tmp_path / "a.npy")


def test_the_log_that_is_read_is_not_written_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    log = tmp_path / "log.npy"
    np.save(log, samples().numpy())
    before = log.read_bytes()
    (tmp_path / "link.npy").symlink_to(log)
    monkeypatch.chdir(tmp_path)
    weights = torch.ones(N_SENSORS).double() / N_SENSORS
    for opened, path in (("log.npy", log), (log, "log.npy"), ("link.npy", "log.npy"), ("log.npy", "link.npy")):
        with pytest.raises(
            ValueError, match=r"`path`: expected another file than the log that is read, got .*; choose"
        ):
            gf.write_virtual(gf.open_recording(opened), weights, path, force=True)
    assert log.read_bytes() == before
    gf.write_virtual(gf.open_recording(log), weights, "virtual.npy")


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path):
    signal = samples()

    def source(start: int, stop: int) -> torch.Tensor:
        if start > 3000:
            raise OSError("the disk is gone")
        return signal[:, start:stop]

    recording = gf.ChunkedRecording(source, N_SENSORS, N_SAMPLES)
    path = tmp_path / "virtual.npy"
    np.save(path, np.arange(3))
    with pytest.raises(OSError, match="the disk is gone"):
        gf.write_virtual(recording, torch.ones(4).double() / 4, path, chunk_samples=500, force=True)
    assert np.load(path).tolist() == [0, 1, 2]
    assert [entry.name for entry in tmp_path.iterdir()] == ["virtual.npy"]


@pytest.mark.parametrize(
    ("old", "new"),
    [("LongRecording", "ChunkedRecording"), ("open_long", "open_recording"), ("stretch_of", "shard_bounds")],
)
def test_old_names_work_with_a_warning(old, new):
    for module in (gf, chunked):
        with pytest.warns(DeprecationWarning, match=rf"{old} is deprecated .*; use gyrofuse\.io\.chunked\.{new}$"):
            assert getattr(module, old) is getattr(chunked, new)
    with pytest.warns(DeprecationWarning, match=r"use gyrofuse\.io\.reading\.read_recording$"):
        assert recording.read_recording is gf.read_recording
