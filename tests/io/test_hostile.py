"""Nothing that a log contains hangs, crashes or misleads its reader: it is read, or refused with name and reason."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hostile_logs import CASES, GYRO, MAT_HEADER, TIME, csv, mat_cells, npz
from logs import made_up, read_with, write_hdf5, write_parquet, write_ros1

import gyrofuse as gf

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import fuzz_readers

from gyrofuse.io.formats import read_streams
from gyrofuse.io.formats.matlab import mat5
from gyrofuse.io.limits import Allowance, physical_memory
from gyrofuse.io.streams import RecordingError


@pytest.mark.parametrize("name", CASES)
def test_a_hostile_log_is_read_or_refused(tmp_path: Path, name: str):
    make, expected = CASES[name]
    log = make(tmp_path)
    if expected is None:
        recording = gf.read_recording(log)
        (str(recording) + json.dumps(recording.to_dict(), allow_nan=False)).encode("utf-8")
        return
    with pytest.raises(RecordingError, match=expected) as refused:
        gf.read_recording(log)
    assert Path(log[0] if isinstance(log, list) else log).name in str(refused.value)
    assert len(str(refused.value)) < 10_000


class TestMemory:
    """Declared sizes are compared with a limit before anything is allocated."""

    @pytest.mark.parametrize("suffix", [".npy", ".npz", ".csv", ".h5", ".mat", ".parquet", ".bag"])
    def test_a_log_beyond_the_limit_names_both_sizes(self, tmp_path: Path, suffix: str):
        path = tmp_path / f"a{suffix}"
        if suffix == ".npy":
            np.save(path, GYRO)
        elif suffix == ".npz":
            npz(tmp_path, gyro=GYRO)
        elif suffix == ".csv":
            csv(tmp_path, "time,gx,gy,gz")
        elif suffix == ".h5":
            write_hdf5(path, {"gyro": GYRO})
        elif suffix == ".mat":
            from scipy.io import savemat

            savemat(path, {"gyro": GYRO}, do_compression=True)
        elif suffix == ".parquet":
            write_parquet(path, {"gx": GYRO[0], "gy": GYRO[1], "gz": GYRO[2]})
        else:
            write_ros1(path, made_up(1, 200), np.arange(200, dtype=np.int64) * 10**7 + 10**18)
        assert gf.read_recording(path, rate=100.0, max_bytes=10**6).axes_as_sensors().signal.shape == (3, 200)
        with pytest.raises(RecordingError, match=rf"a\{suffix}.*max_bytes="):
            gf.read_recording(path, rate=100.0, max_bytes=4000)

    def test_the_default_is_a_share_of_the_memory(self, tmp_path: Path):
        assert Allowance(tmp_path).left == int(0.25 * physical_memory()) > 2**28

    def test_small_numbers_count_as_what_they_become(self, tmp_path: Path):
        path = tmp_path / "a.npy"
        np.save(path, np.zeros((3, 1000), np.int8))
        with pytest.raises(RecordingError, match="of 3 x 1000 numbers"):
            gf.read_recording(path, rate=100.0, max_bytes=20_000)

    def test_a_limit_has_to_be_a_number_of_bytes(self, tmp_path: Path):
        with pytest.raises(ValueError, match="`max_bytes`: expected a finite number > 0, got -1"):
            gf.read_recording(npz(tmp_path, gyro=GYRO), max_bytes=-1)

    def test_a_row_group_beyond_it_is_not_read_by_stretches(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
        path = write_parquet(tmp_path / "a.parquet", {"gx": GYRO[0]})
        monkeypatch.setattr("gyrofuse.io.limits.physical_memory", lambda: 1000)
        with pytest.raises(RecordingError, match="found columns of a row group of 200 x 1 numbers"):
            gf.open_recording(path)


class TestCutShortWhileRead:
    def test_nothing_is_memory_mapped(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
        """A map of a file that another process cuts short ends this one with SIGBUS."""
        path = tmp_path / "a.npy"
        np.save(path, GYRO)

        def mapped(*_: object, **__: object) -> None:
            pytest.fail("the file is mapped into memory")

        monkeypatch.setattr(np, "memmap", mapped)
        assert gf.read_recording(path, rate=100.0).signal.shape == (3, 200)
        np.testing.assert_array_equal(gf.open_recording(path).read(10, 20), GYRO[:, 10:20])

    @pytest.mark.parametrize("suffix", [".npy", ".npz", ".h5", ".parquet"])
    def test_a_long_recording_says_so(self, tmp_path: Path, suffix: str):
        path = tmp_path / f"a{suffix}"
        if suffix == ".npy":
            np.save(path, GYRO)
        elif suffix == ".npz":
            npz(tmp_path, gyro=GYRO)
        elif suffix == ".h5":
            write_hdf5(path, {"gyro": GYRO})
        else:
            write_parquet(path, {"gx": GYRO[0]})
        recording = gf.open_recording(path)
        recording.read(0, 200)
        with path.open("r+b") as file:
            file.truncate(300)
        with pytest.raises(RecordingError, match=rf"a\{suffix}: expected samples 0 to 200, found that they cannot be"):
            recording.read(0, 200)

    @pytest.mark.parametrize("order", ["C", "F"])
    @pytest.mark.parametrize("turned", [False, True])
    def test_stretches_are_those_of_the_array(self, tmp_path: Path, order: str, turned: bool):
        np.save(tmp_path / "a.npy", np.asarray(GYRO.T if turned else GYRO, order=order, dtype=">f4"))
        recording = gf.open_recording(tmp_path / "a.npy")
        np.testing.assert_array_equal(recording.read(17, 90), GYRO[:, 17:90].astype(np.float32))


class TestText:
    def test_latin_1_keeps_its_unit(self, tmp_path: Path):
        path = csv(tmp_path, "time,gx [\xb0/s],gy [\xb0/s],gz [\xb0/s]")
        path.write_bytes(path.read_text(encoding="utf-8").encode("latin-1"))
        recording = gf.read_recording(path)
        assert recording.unit == "deg/s"
        assert any("not UTF-8 and is read as Windows-1252" in str(note) for note in recording.notes)

    def test_utf_8_goes_without_a_note(self, tmp_path: Path):
        recording = gf.read_recording(csv(tmp_path, "time,gx [\xb0/s],gy [\xb0/s],gz [\xb0/s]"))
        assert recording.unit == "deg/s"
        assert not any("UTF-8" in str(note) for note in recording.notes)

    @pytest.mark.parametrize("between", [" ", "   "])
    @pytest.mark.parametrize("decimal", [".", ","])
    def test_quoted_cells_between_blanks(self, tmp_path: Path, between: str, decimal: str):
        rows = [between.join(f'"{x:.4f}"'.replace(".", decimal) for x in row) for row in zip(TIME, *GYRO, strict=True)]
        (tmp_path / "a.csv").write_text("\n".join([between.join(['"time"', '"gx"', '"gy"', '"gz"']), *rows]))
        (stream,) = read_with(read_streams, tmp_path / "a.csv")
        np.testing.assert_allclose([stream.signal[axis] for axis in "xyz"], GYRO, atol=6e-5)

    def test_a_row_of_units_says_where_units_belong(self, tmp_path: Path):
        with pytest.raises(
            RecordingError, match=r"line 2: .* found 's'; correct the line \(units belong behind the na"
        ):
            gf.read_recording(csv(tmp_path, "time,gx,gy,gz\ns,furlong,furlong,furlong"))

    def test_a_clock_without_its_name_is_told(self, tmp_path: Path):
        with pytest.raises(RecordingError, match=r"found neither \(column 'Tijd \[s\]' rises in equal steps .* 'time'"):
            gf.read_recording(csv(tmp_path, "Tijd [s],gx,gy,gz"))

    def test_a_column_that_is_not_asked_for_may_hold_anything(self, tmp_path: Path):
        path = csv(tmp_path, "row,gx,gy,gz", "lost,1,2,3")
        assert gf.read_recording(path, rate=100.0).n_samples == 201

    def test_a_clock_of_dates_is_told(self, tmp_path: Path):
        (tmp_path / "a.csv").write_text("time,gx\n" + "".join(f"01/02/2024 00:00:{i:02},{i % 7}\n" for i in range(60)))
        with pytest.raises(RecordingError, match=r"found neither \(column 'time' holds no numbers and is left out\)"):
            gf.read_recording(tmp_path / "a.csv")


class TestNames:
    def test_halves_of_characters_are_written_out(self, tmp_path: Path):
        path = npz(tmp_path, gyro=GYRO, fs=100.0, sensors=np.array(["\ud800", "b", "c"]))
        assert gf.read_recording(path).sensors[0] == r"\ud800"

    def test_bytes_are_text(self, tmp_path: Path):
        sensors = np.array(["é", "b", "c"]).astype("U1")
        for encoding in ("utf-8", "latin-1"):
            coded = np.array([name.encode(encoding) for name in sensors])
            recording = gf.read_recording(npz(tmp_path, gyro=GYRO, fs=100.0, sensors=coded, unit=np.bytes_(b"\xb0/s")))
            assert (recording.sensors, recording.unit) == (("é", "b", "c"), "deg/s")

    def test_a_dataset_that_is_not_utf_8_is_read_under_its_name(self, tmp_path: Path):
        make, _ = CASES["h5_names_that_are_not_utf8"]
        (stream,) = read_with(read_streams, make(tmp_path))
        np.testing.assert_array_equal([stream.signal[axis] for axis in "xyz"], GYRO)
        np.testing.assert_array_equal(gf.open_recording(tmp_path / "a.h5").read(0, 5), GYRO[:, :5])

    def test_a_file_that_is_named_twice_is_no_second_device(self, tmp_path: Path):
        path = npz(tmp_path, gyro=GYRO, fs=100.0)
        with pytest.raises(ValueError, match=r"a\.npz twice; name it once"):
            gf.read_recording([path, path])


class TestMatlab:
    def test_nesting_up_to_the_limit_is_read(self, tmp_path: Path):
        from scipy.io import loadmat, savemat

        content: dict[str, object] = {"gyro": GYRO, "fs": 100.0}
        for _ in range(30):
            content = {"inner": content}
        savemat(tmp_path / "a.mat", content | {"names": np.array(["a", "b"], object)}, do_compression=True)
        assert loadmat(tmp_path / "a.mat")["inner"].dtype.names == ("inner",)
        np.testing.assert_array_equal(gf.read_recording(tmp_path / "a.mat").signal[:, 0], GYRO)

    @pytest.mark.parametrize("order", ["<", ">"])
    def test_what_is_unpacked_is_what_was_packed(self, tmp_path: Path, order: str):
        from scipy.io import savemat

        content = {"gyro": GYRO, "text": "abc", "s": {"a": [1.0, 2.0], "b": np.array(["x", 1.0], object)}, "z": 1j}
        for packed in (False, True):
            savemat(tmp_path / f"{packed}.mat", content, do_compression=packed)
        plain = [mat5.plain(tmp_path / f"{packed}.mat", Allowance(tmp_path))[128:] for packed in (False, True)]
        assert plain[0] == plain[1] == (tmp_path / "False.mat").read_bytes()[128:]

    def test_entries_beyond_their_matrix_are_refused(self, tmp_path: Path):
        """SciPy would go on in the next variable, one level deeper for each."""
        one = struct_cell(2)
        (tmp_path / "a.mat").write_bytes(MAT_HEADER + one * 5000)
        with pytest.raises(RecordingError, match=r"a\.mat: .* \(elements longer than what they are in\)"):
            gf.read_recording(tmp_path / "a.mat")

    def test_a_shallow_cell_passes(self, tmp_path: Path):
        (tmp_path / "a.mat").write_bytes(mat_cells(20))
        with pytest.raises(RecordingError, match="found no array"):
            gf.read_recording(tmp_path / "a.mat")


def struct_cell(n_entries: int) -> bytes:
    """A cell array that announces entries and holds none."""
    import struct

    body = struct.pack("<IIII", 6, 8, 1, 0) + struct.pack("<IIii", 5, 8, 1, n_entries) + struct.pack("<II", 1, 0)
    return struct.pack("<II", 14, len(body)) + body


class TestErrors:
    def test_what_no_reader_foresaw_names_the_file(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
        path = npz(tmp_path, gyro=GYRO, fs=100.0)

        def fail(*_: object, **__: object) -> None:
            raise ZeroDivisionError("float division by zero")

        for place in ("gyrofuse.io.formats.numpy.recordings.read", "gyrofuse.io.assemble.align"):
            with monkeypatch.context() as patch:
                patch.setattr(place, fail)
                with pytest.raises(RecordingError, match=r"a\.npz: .* \(ZeroDivisionError: float division by zero\)"):
                    gf.read_recording(path)


def _fail(_: object) -> None:
    raise ZeroDivisionError("float division by zero")


def _refuse(_: object) -> None:
    raise RecordingError("expected a log, found something else")


class TestFuzzer:
    """The fuzzer of `tests/benchmarks` sees what it is there to see."""

    @pytest.mark.parametrize(
        ("reader", "ended"),
        [
            (lambda _: time.sleep(60), "hang"),
            (lambda _: os.kill(os.getpid(), signal.SIGKILL), "crash"),
            (_fail, "nameless"),
            (_refuse, "nameless"),
            (gf.read_recording, "read"),
        ],
    )
    def test_an_end_is_told_by_its_name(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: Callable[[object], object], ended: str
    ):
        monkeypatch.setattr(fuzz_readers, "SECONDS", 60 if ended == "read" else 1)
        monkeypatch.setattr(gf, "read_recording", lambda log, rate=None, quantity="rate": reader(log))
        log = csv(tmp_path, "time,gx,gy,gz")
        assert fuzz_readers.outcome(log)[0] == ended
