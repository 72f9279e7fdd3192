"""The third wall: what the library says of a recording, given what a user would have."""

from __future__ import annotations

from typing import Any

import torch

import gyrofuse as gf

_PROCESSES = {
    "white_noise": gf.WhiteNoise,
    "quantization_noise": gf.QuantizationNoise,
    "ar1": gf.AR1,
    "random_walk": gf.RandomWalk,
    "drift": gf.Drift,
    "sinusoid": gf.Sinusoid,
}


def analyse(recording: dict[str, Any], simulation: dict[str, Any], *, false_alarm: float = 0.01) -> dict[str, Any]:
    """Diagnose arrays as they lie in a log, and give the report's dictionary."""
    return gf.diagnose(_recording(recording), _simulation(simulation), false_alarm=false_alarm).to_dict()


def _recording(arrays: dict[str, Any]) -> gf.Recording:
    channels = {
        name: torch.as_tensor(values, dtype=torch.float64)
        for name, values in arrays.items()
        if name not in ("gyro", "fs", "unit", "sensors", "time")
    }
    signal = torch.as_tensor(arrays["gyro"], dtype=torch.float64)
    return gf.Recording(signal, rate=float(arrays["fs"]), unit=str(arrays["unit"]), channels=channels)


def _simulation(given: dict[str, Any]) -> gf.Recording | gf.ArrayModel:
    if "terms" not in given:
        return _recording(given)
    return gf.ArrayModel.from_sensors(
        [gf.Model([_PROCESSES[name](**numbers) for name, numbers in sensor]) for sensor in given["terms"]]
    )
