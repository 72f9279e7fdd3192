"""Command `info`: what is in a log."""

from __future__ import annotations

from gyrofuse.cli.console import say_table
from gyrofuse.cli.options import Logs, Reading, Writing, takes_options
from gyrofuse.cli.reading import say_notes, titled
from gyrofuse.fusion.report.page import number, recording_report, sensor_rows
from gyrofuse.io.recording import Recording


@takes_options
def info(*, logs: Logs, reading: Reading, writing: Writing) -> None:
    """Show what is in a log: sensors, rate, gaps, units, channels."""
    with writing.files([*logs, reading.mounting]) as files:
        recording = reading.read(logs)
        files.write_json(recording.to_dict)
        files.write_report(lambda: recording_report(recording, title=f"What is in {titled(logs)}"))
    _say_recording(recording)


def _say_recording(recording: Recording) -> None:
    facts = [
        ("source", ", ".join(recording.source)),
        ("sensors", str(recording.n_sensors)),
        ("axes", ", ".join(recording.axes) or "-"),
        ("quantity", recording.quantity),
        ("unit", recording.unit),
        ("rate", f"{number(recording.rate, 8)} Hz"),
        ("samples", str(recording.n_samples)),
        ("duration", f"{number(recording.duration, 6)} s"),
    ]
    say_table((), facts)
    sensors = [
        (
            row["name"],
            row["axis"] or "-",
            f"{100 * row['missing']:.3g} %",
            number(row["mean"]),
            number(row["deviation"]),
        )
        for row in sensor_rows(recording)
    ]
    say_table(("sensor", "axis", "missing", "mean", "standard deviation"), sensors, right=(2, 3, 4))
    if recording.channels:
        channels = [(name, " x ".join(map(str, values.shape))) for name, values in recording.channels.items()]
        say_table(("channel", "shape"), channels)
    say_notes(recording)
