"""Text of known loggers: what tells a dialect, what decides a unit or a clock, and what is then said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from logs import read_with

import gyrofuse as gf
from gyrofuse.io.formats.columns import classify_columns
from gyrofuse.io.formats.text import text
from gyrofuse.io.formats.text.dates import kind_of_times, seconds_of
from gyrofuse.io.formats.text.dialects import names_of_message


def read(folder: Path, *lines: str, key: str | None = None):
    path = folder / "log.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return read_with(text.read, path, key=key)


def rows(*cells: object, n: int = 12) -> list[str]:
    """Lines of cells, of which a function is called with the number of its line."""
    return [",".join(str(cell(i) if callable(cell) else cell) for cell in cells) for i in range(n)]


class TestFineTime:
    """SampleTimeFine of Xsens: 10 kHz on an MTi, microseconds on a DOT."""

    @pytest.mark.parametrize(
        ("step", "stated", "rate", "period"),
        [
            (100, "", 100.0, 86400.0),
            (25, "", 400.0, 86400.0),
            (5, "", 2000.0, 86400.0),
            (1000, "", 10.0, 86400.0),
            (2500, "", 4.0, 86400.0),
            (8333, "", 120.005, 2**32 * 1e-6),
            (16667, "", 59.999, 2**32 * 1e-6),
            (1000000, "", 1.0, 2**32 * 1e-6),
            (100, "OutputRate:,100Hz", 100.0, 86400.0),
            (10000, "OutputRate:,1Hz", 1.0, 86400.0),
            (10000, "OutputRate:,100Hz", 100.0, 2**32 * 1e-6),
            (50, "OutputRate:,100Hz", 200.0, 86400.0),  # the other tick would be 20 kHz
        ],
    )
    def test_the_stated_rate_or_what_the_devices_can_do(self, tmp_path: Path, step, stated, rate, period):
        head = [stated] if stated else []
        (stream,) = read(tmp_path, *head, "PacketCounter,SampleTimeFine,Gyr_X", *rows(int, lambda i: 77 + step * i, 1))
        assert 1 / np.diff(stream.time) == pytest.approx(rate, rel=1e-4)
        assert stream.clock_period == pytest.approx(period)
        (note,) = stream.notes
        assert f"a step of {step:g} " in note
        assert ("nearest to the stated" in note) == bool(stated)

    def test_a_rate_that_contradicts_is_said(self, tmp_path: Path):
        read(tmp_path, "OutputRate:,100Hz", "PacketCounter,SampleTimeFine,Gyr_X", *rows(int, lambda i: 50 * i, 1))
        notes = [str(note) for note in gf.read_recording(tmp_path / "log.csv").notes]
        assert any("the log states 100 Hz, the timestamps give 200 Hz, which is used" in note for note in notes)

    def test_lost_packets_without_a_clock(self, tmp_path: Path):
        counts = [65533, 65534, 0, 1, 2, 5, 6]
        (stream,) = read(tmp_path, "// Update Rate: 50.0Hz", "PacketCounter,Gyr_X", *(f"{count},1" for count in counts))
        assert 50 * (stream.time - stream.time[0]) == pytest.approx([0, 1, 3, 4, 5, 8, 9])

    @pytest.mark.parametrize("mark", ["Update Rate: 100.0Hz", "Firmware Version: 1.0", "Colour: red"])
    def test_no_unit_without_the_marks_of_the_maker(self, tmp_path: Path, mark):
        (stream,) = read(tmp_path, f"// {mark}", "PacketCounter,SampleTimeFine,Gyr_X", *rows(int, lambda i: 100 * i, 1))
        assert stream.unit == "unknown"
        assert not any("unit" in note for note in stream.notes)


class TestClocks:
    @pytest.mark.parametrize(
        ("ticks", "unit", "reason"),
        [
            (lambda i: 0.01 * i, "s", "median step of 0.01"),
            (lambda i: 10 * i, "ms", "median step of 10"),
            (lambda i: 10000 * i, "us", "median step of 10000"),
            (lambda i: 1700000000000 + 10 * i, "ms", "in which its readings are dates"),
        ],
    )
    def test_every_guessed_unit_is_said(self, tmp_path: Path, ticks, unit, reason):
        (stream,) = read(tmp_path, "time,gx", *rows(ticks, 1))
        (note,) = stream.notes
        assert note.startswith(f"time column 'time' states no unit: read as {unit} ")
        assert reason in note

    def test_a_stated_rate_decides_the_unit(self, tmp_path: Path):
        (stream,) = read(tmp_path, "# fs = 4000", "time,gx", *rows(lambda i: 250 * i, 1))
        assert np.diff(stream.time) == pytest.approx(250e-6)
        assert stream.notes == ()  # in no other unit do they agree
        (stream,) = read(tmp_path, "# fs = 3500", "time,gx", *rows(lambda i: 250 * i, 1))
        assert stream.notes == (
            "time column 'time' states no unit: read as us from its median step of 250 and the stated 3500 Hz",
        )

    def test_a_rate_that_contradicts_is_said(self, tmp_path: Path):
        read(tmp_path, "# fs = 50", "time [s],gx", *rows(lambda i: 0.01 * i, lambda i: i % 3))
        notes = [str(note) for note in gf.read_recording(tmp_path / "log.csv").notes]
        assert any("the log states 50 Hz, the timestamps give 100 Hz, which is used" in note for note in notes)

    @pytest.mark.parametrize("names", ["sec,nsec", "secs,nsecs", "stamp_sec,stamp_nanosec", "tv_sec,tv_nsec"])
    def test_seconds_and_nanoseconds(self, tmp_path: Path, names):
        cells = rows(lambda i: 5 + (900 + 20 * i) // 1000, lambda i: (900 + 20 * i) % 1000 * 10**6, 1)
        (stream,) = read(tmp_path, f"{names},gx", *cells)
        assert stream.time == pytest.approx(5.9 + 0.02 * np.arange(12))

    def test_total_nanoseconds_are_no_fraction(self, tmp_path: Path):
        cells = rows(lambda i: 5 + i, lambda i: (5 + i) * 10**9, 1)
        (stream,) = read(tmp_path, "time_sec,time_nsec,gx", *cells)
        assert stream.time == pytest.approx(5.0 + np.arange(12))
        assert stream.notes == ()

    def test_a_clock_of_numbers_is_preferred_to_dates(self, tmp_path: Path):
        (stream,) = read(tmp_path, "date,time [ms],gx", *rows("2024-01-01 10:00:00", lambda i: 10 * i, 1))
        assert np.diff(stream.time) == pytest.approx(0.01)


class TestDates:
    @pytest.mark.parametrize(
        ("cell", "seconds"),
        [
            ("1970-01-01T00:00:00Z", 0.0),
            ("1970-01-02 00:00:00.25", 86400.25),
            ("1970/1/1 1:02:03", 3723.0),
            ("2024-02-29T23:59:59.123456789Z", 1709251199.123456789),
            ("2024-02-29T23:59:59+02:00", 1709243999.0),
            ("2024-02-29T23:59:59-0130", 1709256599.0),
            ("29.02.2024 23:59:59,5", 1709251199.5),
            ("29-Feb-2024 23:59:59.500", 1709251199.5),
            ("23:59:59.010", 86399.01),
            ("23:59:59:010", 86399.01),
        ],
    )
    def test_seconds(self, cell, seconds):
        assert seconds_of(cell) == seconds
        assert kind_of_times([cell]) == ("date" if len(cell) > 12 else "time of day")

    @pytest.mark.parametrize("cell", ["", " ", "null", "NaN"])
    def test_absent(self, cell):
        assert np.isnan(seconds_of(cell))

    @pytest.mark.parametrize(
        "cell", ["01/02/2024 10:00:00", "2024-13-01 00:00:00", "24:00:00", "12:60:00", "1.5", "x" * 10**6, "12:00"]
    )
    def test_refused(self, cell):
        with pytest.raises(ValueError, match=r"could not convert|month must be|there is no such"):
            seconds_of(cell)

    def test_a_bad_date_names_its_line(self, tmp_path: Path):
        lines = rows(lambda i: f"2024-01-01 10:00:00.{i:03d}", 1, n=300)
        lines[250] = "2024-01-01 1o:00:00.250,1"
        with pytest.raises(gf.RecordingError, match=r"log\.csv, line 252: expected numbers in the columns gx, time"):
            read(tmp_path, "time,gx", *lines)

    def test_without_a_header(self, tmp_path: Path):
        streams = read(tmp_path, *rows(lambda i: f"10:00:00.{10 * i:03d}", lambda i: i % 5, lambda i: i % 3))
        assert [stream.name for stream in streams] == ["1", "2"]
        assert streams[0].time == pytest.approx(36000 + 0.01 * np.arange(12))
        assert streams[0].clock_period == 86400


class TestNames:
    @pytest.mark.parametrize(
        ("name", "kind", "axis", "unit"),
        [
            ("xRate (deg/s)", "rate", "x", "deg/s"),
            ("rate_x", "rate", "x", ""),
            ("imu1_rate_z_dps", "rate", "z", "deg/s"),
            ("gyro_x_deg_h", "rate", "x", "deg/h"),
            ("G_x [mdps]", "rate", "x", "mdeg/s"),
            ("AsX(°/s)", "rate", "x", "deg/s"),
            ("axisRate[0]", "", "", ""),
            ("heart_rate", "", "", ""),
            ("rates", "", "", ""),
            ("angular_velocity_covariance0", "", "", ""),
            ("orientation_covariance_8", "", "", ""),
            ("AccX_g", "acceleration", "x", "g"),
            ("A_X [mg]", "acceleration", "x", "mg"),
            ("X_ACCL_OUT", "acceleration", "x", ""),
            ("MagX [mG]", "magnetic_field", "x", "mG"),
            ("T(°C)", "temperature", "", "degC"),
            ("Temp_C", "temperature", "", "degC"),
            ("Gps Seconds [s]", "time", "", "s"),
            ("Zeit [s]", "time", "", "s"),
            ("Timestamp [ns]", "time", "", "ns"),
            ("nanosec", "time", "", "ns"),
            ("SampleTimeCoarse", "", "", ""),
            ("x_sec", "", "", ""),
        ],
    )
    def test_what_a_name_says(self, name, kind, axis, unit):
        (column, _) = classify_columns([name, "gx"])
        assert (column.kind, column.axis, column.unit) == (kind, axis, unit)

    @pytest.mark.parametrize(
        ("log", "but"), [("Accelerometer", ", though the log is called Accelerometer"), ("Gyroscope", ""), ("x", "")]
    )
    def test_a_log_of_another_sensor(self, tmp_path: Path, log, but):
        (tmp_path / f"{log}.csv").write_text("seconds_elapsed,z,y,x\n0.0,1,2,3\n0.1,1,2,3\n")
        (stream,) = read_with(text.read, tmp_path / f"{log}.csv")
        assert stream.notes == (f"columns z, y, x name no sensor and are read as a gyro's{but}",)

    def test_p_q_r_beside_a_gyro_are_none(self):
        assert [column.kind for column in classify_columns(["p", "q", "r", "gx"])] == ["", "", "", "rate"]
        assert [column.kind for column in classify_columns(["p", "q", "T [degC]"])] == ["", "", "temperature"]


class TestUnits:
    @pytest.mark.parametrize("units", ["s,deg/s,deg/s", "[s],[deg/s],[deg/s]", ",dps,dps", "-,°/s,°/s"])
    def test_a_row_of_units(self, tmp_path: Path, units):
        (stream,) = read(tmp_path, "time,gx,gy", units, *rows(lambda i: 0.01 * i, 1, 2))
        assert stream.unit == "deg/s"
        assert "line 2 holds the units of the columns" in stream.notes

    def test_a_unit_behind_the_name_is_preferred(self, tmp_path: Path):
        (stream,) = read(tmp_path, "time,gx [rad/s]", "s,deg/s", *rows(lambda i: 0.01 * i, 1))
        assert stream.unit == "rad/s"


def message(i: int, *, stamped: bool) -> list[float | str]:
    covariance = [0.1, 0, 0, 0, 0.1, 0, 0, 0, 0.1]
    body = [0, 0, 0, 1, *covariance, 1 + i, 2, 3, *covariance, 4, 5, 6, *covariance]
    return [7, 10**7 * i, "imu", *body] if stamped else body


class TestMessages:
    @pytest.mark.parametrize("stamped", [True, False])
    def test_cells_of_an_imu(self, stamped):
        rows = [[str(cell) for cell in message(i, stamped=stamped)] for i in range(3)]
        names = names_of_message(rows)
        assert [names[rows[0].index(cell)] for cell in "23"] == ["angular_velocity.y", "angular_velocity.z"]
        assert len(names) == len(rows[0])

    @pytest.mark.parametrize(
        ("stamped", "position", "cell"),
        [
            (True, 1, "1e9"),  # not below a second
            (True, 1, "0.5"),
            (True, 6, "0.3"),  # a quaternion of another length
            (False, 3, "0.3"),
            (False, 5, "0.3"),  # a covariance that is not symmetric
            (False, 35, "0.3"),
            (False, 35, "word"),
        ],
    )
    def test_others_of_that_width(self, stamped, position, cell):
        row = [str(cell) for cell in message(0, stamped=stamped)]
        row[position] = cell
        assert names_of_message([row]) == ()

    def test_of_no_attitude(self):
        row = [str(cell) for cell in message(0, stamped=True)]
        row[6] = "0"
        row[7] = "-1"  # "there is no attitude"
        assert names_of_message([row])


class TestRegisters:
    def test_with_and_without_sign(self, tmp_path: Path):
        (stream,) = read(tmp_path, "X_GYRO_OUT,X_GYRO_LOW", "-2,5", "65534,5", "3,-1", "3,65535")
        assert stream.signal["x"].tolist() == [-2 * 65536 + 5, -2 * 65536 + 5, 3 * 65536 + 65535, 3 * 65536 + 65535]
        assert (stream.unit, stream.name) == ("counts", "log")

    def test_of_16_bits(self, tmp_path: Path):
        (stream,) = read(tmp_path, "X_GYRO_OUT,Y_GYRO_OUT", "65535,1", "2,3")
        assert [values.tolist() for values in stream.signal.values()] == [[-1, 2], [1, 3]]
        assert stream.notes == ()

    def test_of_scaled_numbers(self, tmp_path: Path):
        (stream,) = read(tmp_path, "X_GYRO_OUT,X_GYRO_LOW", "0.25,5", "0.5,5")
        assert stream.signal["x"].tolist() == [0.25, 0.5]
        assert stream.unit == "unknown"
        assert stream.notes == ("columns X_GYRO_LOW are left out: beside them are no whole numbers of 16 bits",)


class TestFlightControllers:
    NAMES = "loopIteration,time,gyroADC[0],gyroADC[1],accSmooth[0],accSmooth[1],accSmooth[2]"

    @pytest.mark.parametrize(
        ("settings", "unit", "factor", "says"),
        [
            (['"gyro_scale","0x3f800000"'], "deg/s", 1.0, ""),
            (
                ['"gyro_scale","0x3f800000"', '"blackbox_high_resolution","1"'],
                "deg/s",
                0.1,
                "rates are logged in tenths of deg/s",
            ),
            (['"gyro_scale","0x3089705f"'], "unknown", 1.0, "gyro_scale is 1e-09, not the 1 of logs in deg/s"),
            ([], "deg/s", 1.0, "the file does not say"),
            (['"gyro_scale","nonsense"'], "deg/s", 1.0, "the file does not say"),
        ],
    )
    def test_scale(self, tmp_path: Path, settings, unit, factor, says):
        cells = rows(int, lambda i: 125 * i, 30, -20, 100, 0, 2048)
        (stream,) = read(tmp_path, *settings, '"acc_1G","2048"', self.NAMES, *cells)
        assert (stream.unit, stream.signal["x"][0]) == (unit, pytest.approx(30 * factor))
        assert np.diff(stream.time) == pytest.approx(125e-6)
        assert stream.channels["acceleration"][:, 0].tolist() == [100 / 2048, 0, 1]
        assert not says or any(says in note for note in stream.notes)

    def test_a_column_by_its_name(self, tmp_path: Path):
        (stream,) = read(tmp_path, self.NAMES, *rows(int, lambda i: 125 * i, 30, -20, 100, 0, 2048), key="accSmooth[2]")
        assert (stream.name, stream.signal[""].tolist()) == ("accSmooth[2]", [2048.0] * 12)

    def test_units_of_the_decoder_are_kept(self, tmp_path: Path):
        names = "loopIteration, time (us), gyroADC[0] (rad/s), " + ", ".join(
            f"accSmooth[{i}] (m/s/s)" for i in range(3)
        )
        (stream,) = read(tmp_path, names, *rows(int, lambda i: 125 * i, 0.5, 1, 2, 3))
        assert (stream.unit, stream.signal["x"][0], stream.channel_units) == ("rad/s", 0.5, {"acceleration": "m/s^2"})
