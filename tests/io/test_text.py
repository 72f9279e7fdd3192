"""Text files: delimiters, headers, preambles, comments, empty cells, and lines that do not fit."""

from pathlib import Path

import numpy as np
import pytest
from logs import made_up, read_with

from gyrofuse.io.formats import read_streams
from gyrofuse.io.formats.text import text
from gyrofuse.io.streams import RecordingError

GYRO = made_up(1, 40)[0]
TIME = np.arange(40) / 100
XSENS_DOT = """DeviceTag:,Xsens DOT
FirmwareVersion:,1.6.0
OutputRate:,60Hz
StartTime:,2023-01-01_10:00:00
\u00a9 Xsens Technologies B. V. 2005-2023

"""


def write(folder: Path, content: str, encoding: str = "utf-8") -> Path:
    path = folder / "log.csv"
    path.write_bytes(content.encode(encoding))
    return path


def read(folder: Path, content: str, key: str | None = None):
    return read_with(text.read, write(folder, content), key=key)


def rows(*columns: np.ndarray, delimiter: str = ",", decimal: str = ".") -> str:
    """Lines with every digit of the numbers."""
    lines = [
        delimiter.join(repr(float(cell)).replace(".", decimal) for cell in row) for row in zip(*columns, strict=True)
    ]
    return "\n".join(lines) + "\n"


def axes(stream) -> list[np.ndarray]:
    return [stream.signal[axis] for axis in "xyz"]


class TestLayout:
    @pytest.mark.parametrize(
        ("delimiter", "decimal"),
        [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), (" ", "."), ("   ", ",")],
    )
    @pytest.mark.parametrize("names", [("t", "gx", "gy", "gz"), ()], ids=["header", "none"])
    def test_delimiters_and_decimal_commas(self, tmp_path: Path, delimiter, decimal, names):
        header = delimiter.join(names) + "\n" if names else ""
        streams = read(tmp_path, header + rows(TIME, *GYRO, delimiter=delimiter, decimal=decimal))
        np.testing.assert_array_equal([row for stream in streams for row in stream.signal.values()], GYRO)
        assert [stream.name for stream in streams] == (["log"] if names else ["1", "2", "3"])
        for stream in streams:
            np.testing.assert_array_equal(stream.time, TIME)

    @pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
    @pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
    def test_encodings_and_line_ends(self, tmp_path: Path, encoding, newline):
        content = ("t,gx,gy,gz\n" + rows(TIME, *GYRO)).replace("\n", newline)
        (stream,) = read_with(text.read, write(tmp_path, content, encoding))
        np.testing.assert_array_equal(axes(stream), GYRO)

    def test_comma_and_space(self, tmp_path: Path):
        (stream,) = read(tmp_path, "t , gx,  gy\n 0.0, 1.5 , 2\n 0.1,  , 3 \n")
        np.testing.assert_array_equal([stream.signal["x"], stream.signal["y"]], [[1.5, np.nan], [2, 3]])

    def test_quotes(self, tmp_path: Path):
        (stream,) = read(tmp_path, '"t","remark","gx"\n"0.0","a, b","1"\n"0.1","","2"\n')
        assert stream.signal["x"].tolist() == [1, 2]

    @pytest.mark.parametrize("header", ["t,gx,gy", "t,gx,gy,"])
    @pytest.mark.parametrize("end", [",", ", ", ""])
    def test_trailing_delimiter(self, tmp_path: Path, header, end):
        (stream,) = read(tmp_path, f"{header}\n0.0,1,2{end}\n0.1,3,4{end}\n")
        assert (stream.signal["x"].tolist(), stream.signal["y"].tolist()) == ([1, 3], [2, 4])

    def test_empty_cells_and_numbers_that_are_not_finite(self, tmp_path: Path):
        (stream,) = read(tmp_path, "gx,gy,gz\n1,,\n,nan,inf\n-inf,NaN,1e-3\n,,\n4,5,6\n")
        nan, inf = np.nan, np.inf
        np.testing.assert_array_equal(
            axes(stream), [[1, nan, -inf, nan, 4], [nan, nan, nan, nan, 5], [nan, inf, 1e-3, nan, 6]]
        )

    @pytest.mark.parametrize("delimiter", ["\t", ";"])
    def test_empty_cells_beside_other_delimiters(self, tmp_path: Path, delimiter):
        (stream,) = read(tmp_path, "gx,gy,gz\n1,2,3\n,5,6\n7,,9\n10,11,\n".replace(",", delimiter))
        nan = np.nan
        np.testing.assert_array_equal(axes(stream), [[1, nan, 7, 10], [2, 5, nan, 11], [3, 6, 9, nan]])

    def test_comments_and_blank_lines_between_rows(self, tmp_path: Path):
        (stream,) = read(tmp_path, "gx\n1\n# gap\n2\n\n% gap\n// gap\n3\n")
        assert stream.signal["x"].tolist() == [1, 2, 3]

    def test_preamble(self, tmp_path: Path):
        (stream,) = read(tmp_path, XSENS_DOT + "PacketCounter,SampleTimeFine,Gyr_X,Gyr_Y,Gyr_Z,\n" + 2 * "1,5,2,3,4,\n")
        assert (axes(stream)[0].tolist(), stream.rate) == ([2, 2], 60.0)

    @pytest.mark.parametrize(
        "preamble",
        [
            "# fs = 100, unit: deg/s\n",
            "# unit: deg/s\n# sampling_rate: 100 Hz\n",
            "// Update Rate: 100.0Hz\n// Unit: dps\n",
            "% Fs=100\n% unit = deg/s\n",
        ],
    )
    @pytest.mark.parametrize("header", ["gx,gy\n", ""])
    def test_rate_and_unit_above_the_table(self, tmp_path: Path, preamble, header):
        for stream in read(tmp_path, preamble + header + "3,1\n1,4\n2,2\n"):
            assert (stream.rate, stream.unit, stream.n_samples) == (100.0, "deg/s", 3)

    def test_header_as_a_comment(self, tmp_path: Path):
        np.savetxt(tmp_path / "a.txt", np.vstack([TIME, GYRO]).T, header="t gx gy gz", fmt="%.17g")
        (stream,) = read_with(text.read, tmp_path / "a.txt")
        np.testing.assert_array_equal(axes(stream), GYRO)

    def test_euroc(self, tmp_path: Path):
        header = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2]\n"
        (stream,) = read(tmp_path, header + "1403636579758555392,1,2,3,9\n1403636579763555584,4,5,6,9\n")
        assert (stream.unit, [a.tolist() for a in axes(stream)]) == ("rad/s", [[1, 4], [2, 5], [3, 6]])
        assert np.diff(stream.time) == pytest.approx(0.005, abs=1e-6)


class TestColumns:
    def test_devices_by_their_prefixes(self, tmp_path: Path):
        gyro = made_up(2)
        names = [f"imu{i}_{c}{a}" for i in (1, 2) for c in "ga" for a in "xyz"]
        values = [row for device in gyro for row in (*device, *(2 * device))]
        content = ",".join(["t", *names, "temperature [degC]"]) + "\n" + rows(TIME, *(v[:40] for v in values), TIME)
        streams = read(tmp_path, content)
        assert [stream.name for stream in streams] == ["imu1", "imu2"]
        for stream, device in zip(streams, gyro, strict=True):
            np.testing.assert_array_equal(axes(stream), device[:, :40])
            np.testing.assert_array_equal(stream.channels["acceleration"], 2 * device[:, :40])
        np.testing.assert_array_equal([stream.time for stream in streams], [TIME, TIME])
        np.testing.assert_array_equal(streams[0].channels["temperature"], TIME)
        assert streams[0].channel_units == {"temperature": "degC"}
        (only,) = read(tmp_path, content, key="imu2")
        np.testing.assert_array_equal(axes(only), gyro[1, :, :40])

    def test_text_columns_are_skipped(self, tmp_path: Path):
        (stream,) = read(tmp_path, "date,state,gx\n2024-01-01 10:00:00,on,1\n2024-01-01 10:00:01,off,2\n")
        assert stream.signal["x"].tolist() == [1, 2]

    def test_a_clock_of_dates_is_noted(self, tmp_path: Path):
        (stream,) = read(tmp_path, "timestamp,gx\n10:00:00.00,1\n10:00:00.01,2\n")
        np.testing.assert_allclose(stream.time, [36000, 36000.01], rtol=1e-12)
        (note,) = stream.notes
        assert note == "column 'timestamp' holds times of day, which begin again at midnight, and is read as time"

    def test_a_name_that_stands_there_twice(self, tmp_path: Path):
        (stream,) = read(tmp_path, "gx,gx\n1,5\n2,6\n")
        assert stream.signal["x"].tolist() == [1, 2]
        assert stream.notes == ("column 'gx' stands there twice; the first is read",)

    def test_key_names_a_column(self, tmp_path: Path):
        content = "t,volt,gx\n0.0,1,7\n0.1,2,8\n"
        (stream,) = read(tmp_path, content, key="volt")
        assert (stream.name, list(stream.signal), stream.signal[""].tolist()) == ("volt", [""], [1, 2])
        (stream,) = read(tmp_path, content, key="gx")
        assert stream.signal["x"].tolist() == [7, 8]
        with pytest.raises(RecordingError, match=r"expected a column or device 'gy' \(`key`\), found t, volt, gx"):
            read(tmp_path, content, key="gy")

    def test_clock_of_32_bit(self, tmp_path: Path):
        (stream,) = read(tmp_path, "SampleTimeFine,Gyr_X\n4294950632,1\n4294958965,2\n2,3\n8335,4\n16668,5\n")
        assert stream.clock_period == pytest.approx(2**32 * 1e-6)
        np.testing.assert_allclose(stream.time, [4294.950632, 4294.958965, 2e-6, 0.008335, 0.016668], rtol=1e-12)


class TestNoHeader:
    def test_columns_are_sensors(self, tmp_path: Path):
        streams = read(tmp_path, rows(*GYRO))
        assert [(stream.name, list(stream.signal)) for stream in streams] == [("1", [""]), ("2", [""]), ("3", [""])]
        np.testing.assert_array_equal([stream.signal[""] for stream in streams], GYRO)
        assert streams[0].time is None

    def test_one_column_has_the_name_of_the_file(self, tmp_path: Path):
        (stream,) = read(tmp_path, rows(GYRO[0]))
        assert stream.name == "log"
        np.testing.assert_array_equal(stream.signal[""], GYRO[0])

    def test_a_clock_is_noted(self, tmp_path: Path):
        (stream,) = read(tmp_path, rows(TIME, GYRO[0]))
        np.testing.assert_array_equal(stream.time, TIME)
        assert any("advances in nearly constant steps and is read as time" in note for note in stream.notes)

    def test_a_count_is_no_clock(self, tmp_path: Path):
        first, second = read(tmp_path, rows(np.arange(40), *GYRO[:2]))
        assert first.time is None
        np.testing.assert_array_equal([first.signal[""], second.signal[""]], GYRO[:2])
        assert any("taken as a count of the rows" in note for note in first.notes)

    def test_columns_that_all_advance_are_sensors(self, tmp_path: Path):
        assert len(read(tmp_path, "0,1\n2,3\n4,5\n6,7\n")) == 2

    def test_key_is_a_number(self, tmp_path: Path):
        (stream,) = read(tmp_path, rows(TIME, *GYRO), key="2")
        np.testing.assert_array_equal(stream.signal[""], GYRO[1])
        np.testing.assert_array_equal(stream.time, TIME)
        with pytest.raises(
            RecordingError, match=r"expected a sensor '4' \(`key`\), found no header and the sensors 1, 2, 3"
        ):
            read(tmp_path, rows(*GYRO), key="4")


class TestRefused:
    def test_a_cell_that_is_no_number(self, tmp_path: Path):
        lines = ["# made up", "t,gx", *(f"{i / 100},1.0" for i in range(500))]
        lines[321] = "3.19,oops"
        with pytest.raises(
            RecordingError, match=r"log\.csv, line 322: expected numbers in the columns t, gx, found 'oops'"
        ):
            read(tmp_path, "\n".join(lines))

    @pytest.mark.parametrize(("line", "n_cells"), [("0.5,1", 2), ("0.5,1,2,3", 4), ("0.5", 1)])
    @pytest.mark.parametrize("delimiter", [",", ";", "\t", " "])
    @pytest.mark.parametrize("header", ["t,gx,gy", "3,1,4"], ids=["header", "none"])
    def test_a_ragged_line(self, tmp_path: Path, line, n_cells, delimiter, header):
        lines = [header, *["0.1,1,2"] * 250]
        lines[240] = line
        with pytest.raises(RecordingError, match=rf"log\.csv, line 241: expected 3 cells .* found {n_cells}"):
            read(tmp_path, "\n".join(lines).replace(",", delimiter))

    @pytest.mark.parametrize("header", ["", "t,gx\n"])
    def test_an_early_bad_cell_is_no_header(self, tmp_path: Path, header):
        with pytest.raises(RecordingError, match="found 'bad'"):
            read(tmp_path, header + "0.1,2\n0.2,bad\n0.3,1\n0.4,5\n")

    def test_names_and_numbers_in_one_line(self, tmp_path: Path):
        with pytest.raises(RecordingError, match="line 1: expected names or numbers, found both"):
            read(tmp_path, "0.1,x\n0.2,1\n0.3,1\n")

    @pytest.mark.parametrize("content", ["t gx gy remark\n0 1 3\n1 2 1\n", "gx\n1,5\n2,5\n"])
    def test_a_header_of_another_length(self, tmp_path: Path, content):
        with pytest.raises(RecordingError, match=r"expected a header of .* names, one for each cell of a row, found"):
            read(tmp_path, content)

    def test_no_gyro(self, tmp_path: Path):
        with pytest.raises(RecordingError, match=r"name of a gyro \(gyro_x, gx\), found time, volt; say with `col"):
            read(tmp_path, "time,volt\n0,1\n1,2\n")

    @pytest.mark.parametrize("content", ["\n\n", "gx,gy\n", "some words\nand more of them\n", "# fs = 100\n", '"'])
    def test_no_rows_of_numbers(self, tmp_path: Path, content):
        with pytest.raises(RecordingError, match=r"log\.csv: expected rows of numbers, found none"):
            read(tmp_path, content)

    def test_one_row(self, tmp_path: Path):
        with pytest.raises(RecordingError, match="expected at least 2 rows of numbers, found 1; record longer"):
            read(tmp_path, "gx,gy\n1,2\n")

    def test_binary(self, tmp_path: Path):
        path = tmp_path / "log.csv"
        path.write_bytes(bytes(range(256)))
        with pytest.raises(RecordingError, match=r"log\.csv: expected text, found binary data"):
            read_with(text.read, path)

    def test_a_directory(self, tmp_path: Path):
        with pytest.raises(RecordingError, match="found a file that cannot be read"):
            read_with(text.read, tmp_path)


class TestRealFiles:
    @pytest.mark.parametrize(("number", "n_samples", "start"), [(1, 22903, 677.583), (2, 22864, 677.516336)])
    def test_xsens_dot(self, shared: Path, number, n_samples, start):
        (stream,) = read_with(read_streams, shared / "data" / "raw" / f"xsens_dot{number}_flight.csv")
        assert (stream.n_samples, stream.unit, stream.rate) == (n_samples, "unknown", None)
        assert stream.time[0] == pytest.approx(start, abs=1e-9)
        assert stream.clock_period == pytest.approx(2**32 * 1e-6)
        with np.load(shared / "data" / "xsensdot4_quadrotor.npz") as file:
            np.testing.assert_allclose(axes(stream), file[f"111438_DOT{number}"][:3], rtol=1e-6)
            np.testing.assert_allclose(stream.channels["acceleration"], file[f"111438_DOT{number}"][3:], rtol=1e-6)
        assert set(stream.channels) == {"acceleration", "magnetic_field"}
